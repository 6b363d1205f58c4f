//! Tables: rows with tokens.

use std::collections::BTreeMap;
use std::path::Path;

use glam::DQuat;
use serde_json::Value;
use store::file::{SaveError, save};

use super::super::output::create_folder;

/// All tables. The devkit needs each, also without rows.
const NAMES: [&str; 13] = [
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
];

/// Rows by table.
#[derive(Default)]
pub(super) struct Tables(BTreeMap<&'static str, Vec<Value>>);

impl Tables {
    pub(super) fn push(&mut self, table: &'static str, row: Value) {
        self.extend(table, vec![row]);
    }

    pub(super) fn extend(&mut self, table: &'static str, rows: Vec<Value>) {
        self.0.entry(table).or_default().extend(rows);
    }

    /// Writes a file for each table, a row a line.
    pub(super) fn save(&self, folder: &Path) -> Result<(), SaveError> {
        create_folder(folder)?;
        NAMES.iter().try_for_each(|name| {
            let rows: Vec<String> = self.0.get(name).into_iter().flatten().map(Value::to_string).collect();
            save(&folder.join(format!("{name}.json")), format!("[\n{}\n]\n", rows.join(",\n")).as_bytes())
        })
    }
}

/// The token of a row: 32 hexadecimal digits that depend on its table and name.
pub(super) fn token(parts: &[&str]) -> String {
    blake3::hash(parts.join("\n").as_bytes()).to_hex()[..32].to_owned()
}

/// Names the row before and the row after in each.
pub(super) fn chained(mut rows: Vec<Value>) -> Vec<Value> {
    let tokens: Vec<Value> = rows.iter().map(|row| row["token"].clone()).collect();
    let at = |i: Option<usize>| i.and_then(|i| tokens.get(i).cloned()).unwrap_or_else(|| "".into());
    for (i, row) in rows.iter_mut().enumerate() {
        row["prev"] = at(i.checked_sub(1));
        row["next"] = at(Some(i + 1));
    }
    rows
}

/// w, x, y, z.
pub(super) fn quaternion(q: DQuat) -> [f64; 4] {
    [q.w, q.x, q.y, q.z]
}
