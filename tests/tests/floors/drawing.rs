//! The import graph between crates as an SVG for the documentation: a row per floor, an arrow per import that no longer path implies.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

const BOX: [f64; 2] = [112.0, 34.0];
const COLUMN: f64 = 140.0;
const ROW: f64 = 92.0;
const MARGIN: f64 = 24.0;

/// Draws crates by height, lowest height at the bottom, and the edges `(from, to)` between them.
pub(crate) fn draw(heights: &BTreeMap<String, u32>, edges: &BTreeSet<(String, String)>) -> String {
    let rows: BTreeSet<u32> = heights.values().copied().collect();
    let members = |height: u32| heights.iter().filter(move |(_, at)| **at == height).map(|(name, _)| name);
    let widest = rows.iter().map(|&height| members(height).count()).max().unwrap_or(0) as f64;
    let [width, height] = [2.0 * MARGIN + widest * COLUMN, 2.0 * MARGIN + rows.len() as f64 * ROW];
    let mut places = BTreeMap::new();
    for (row, &at) in rows.iter().rev().enumerate() {
        let count = members(at).count() as f64;
        for (column, name) in members(at).enumerate() {
            // Every second row is moved, so that arrows over more than one row pass between boxes.
            let shift = if row % 2 == 0 { 0.0 } else { 0.18 * COLUMN };
            let x = 0.5 * width + (column as f64 + 0.5 - 0.5 * count) * COLUMN + shift;
            places.insert(name.as_str(), [x, MARGIN + (row as f64 + 0.5) * ROW]);
        }
    }
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"14\">\n\
         <defs><marker id=\"head\" viewBox=\"0 0 8 8\" refX=\"7\" refY=\"4\" markerWidth=\"7\" markerHeight=\"7\" orient=\"auto\">\
         <path d=\"M0 0 8 4 0 8z\" fill=\"#667\"/></marker></defs>\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
    );
    for (from, to) in edges.iter().filter(|(from, to)| !is_implied(from, to, edges)) {
        let ([x0, y0], [x1, y1]) = (places[from.as_str()], places[to.as_str()]);
        let [y0, y1] = [y0 + 0.5 * BOX[1], y1 - 0.5 * BOX[1]];
        writeln!(svg, "<path d=\"M{x0:.0} {y0:.0} {x1:.0} {y1:.0}\" stroke=\"#667\" marker-end=\"url(#head)\"/>")
            .expect("a string");
    }
    for (name, [x, y]) in places {
        let [left, top] = [x - 0.5 * BOX[0], y - 0.5 * BOX[1]];
        let [w, h] = BOX;
        writeln!(
            svg,
            "<rect x=\"{left:.0}\" y=\"{top:.0}\" width=\"{w}\" height=\"{h}\" rx=\"5\" fill=\"#eef3fa\" stroke=\"#346\"/>\
             <text x=\"{x:.0}\" y=\"{:.0}\" text-anchor=\"middle\">{name}</text>",
            y + 5.0
        )
        .expect("a string");
    }
    svg + "</svg>\n"
}

/// Whether a longer path leads from `from` to `to`.
fn is_implied(from: &str, to: &str, edges: &BTreeSet<(String, String)>) -> bool {
    let next =
        |of: &str| edges.iter().filter(move |(user, _)| user == of).map(|(_, used)| used.as_str()).collect::<Vec<_>>();
    let mut open: Vec<&str> = next(from).into_iter().filter(|used| *used != to).collect();
    let mut seen = BTreeSet::new();
    while let Some(name) = open.pop() {
        if name == to {
            return true;
        }
        if seen.insert(name) {
            open.extend(next(name));
        }
    }
    false
}
