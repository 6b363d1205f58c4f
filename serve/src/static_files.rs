//! Files of the served folder: models and exports, with ranges, as any file server has them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

/// Files listed for download, and how deep they are looked for.
const LISTED: usize = 500;
const DEPTH: usize = 3;
/// Folders that are not offered: the store is for programs.
const HIDDEN: [&str; 1] = ["store"];

/// The files to download, largest folders last.
pub(crate) fn downloads(root: &Path) -> Value {
    let mut files = Vec::new();
    list(root, "", DEPTH, &mut files);
    json!({"files": files})
}

fn list(folder: &Path, prefix: &str, depth: usize, files: &mut Vec<Value>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    let mut entries: Vec<_> = entries.flatten().collect();
    entries.sort_by_key(|entry| (entry.path().is_dir(), entry.file_name()));
    for entry in entries {
        let name = entry.file_name().to_string_lossy().into_owned();
        let Ok(about) = entry.metadata() else { continue };
        if files.len() >= LISTED || name.starts_with('.') || HIDDEN.contains(&name.as_str()) {
            continue;
        }
        let path = format!("{prefix}{name}");
        if about.is_file() {
            files.push(json!({"name": name, "path": path, "bytes": about.len(), "blake3": null}));
        } else if about.is_dir() && depth > 1 {
            list(&entry.path(), &format!("{path}/"), depth - 1, files);
        }
    }
}
