//! Reads the detections of a sweep of a radar: a table of comma-separated values, with a line of column names and a line per detection.
//!
//! | column | value |
//! |---|---|
//! | `range` | metres |
//! | `azimuth` | radians to the left of the sensor's x axis |
//! | `velocity` | radial, relative to the sensor, metres per second, positive away from it |
//!
//! Other columns are ignored.

use crate::error::CodecError;

/// Most detections of a sweep.
const MAX_DETECTIONS: usize = 100_000;

/// A detection of a radar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Metres.
    pub range: f64,
    /// Radians to the left of the sensor's x axis.
    pub azimuth: f64,
    /// Radial velocity relative to the sensor, metres per second, positive away from it.
    pub velocity: f64,
}

/// Reads the table.
///
/// # Errors
/// A column that is missing, a value that is not a finite number, or over 100,000 detections.
pub fn read_detections(bytes: &[u8]) -> Result<Vec<Detection>, CodecError> {
    detections(bytes).map_err(CodecError::new)
}

fn detections(bytes: &[u8]) -> Result<Vec<Detection>, String> {
    let text = std::str::from_utf8(bytes).map_err(|_| "is not UTF-8 text".to_owned())?;
    let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let (_, head) = lines.next().ok_or("has no line of column names")?;
    let column = |name: &'static str| {
        let found = head.split(',').position(|of| of.trim() == name);
        found.map(|column| (name, column)).ok_or_else(|| format!("has no column {name}"))
    };
    let columns = [column("range")?, column("azimuth")?, column("velocity")?];
    let mut found = Vec::new();
    for (number, line) in lines {
        if found.len() == MAX_DETECTIONS {
            return Err(format!("has over {MAX_DETECTIONS} detections"));
        }
        let mut values = [0.0f64; 3];
        for (value, (name, column)) in values.iter_mut().zip(columns) {
            let cell = line.split(',').nth(column).ok_or_else(|| format!("has too few columns in line {number}"))?;
            let found = cell.trim().parse().ok().filter(|v: &f64| v.is_finite());
            *value = found.ok_or_else(|| format!("has no number in line {number}, column {name}"))?;
        }
        let [range, azimuth, velocity] = values;
        found.push(Detection { range, azimuth, velocity });
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name() {
        let table = "power, velocity ,azimuth,range\n9,-10,0,20\n\n8,0.5,1.25,3\n";
        let found = read_detections(table.as_bytes()).unwrap();
        assert_eq!((found.len(), found[0].range, found[0].velocity), (2, 20.0, -10.0));
        assert_eq!((found[0].azimuth, found[1].azimuth), (0.0, 1.25));
    }

    #[test]
    fn tables_that_are_none_are_refused() {
        let long = format!("range,azimuth,velocity\n{}", "1,0,0\n".repeat(MAX_DETECTIONS + 1));
        for (table, problem) in [
            ("", "has no line of column names"),
            ("range,azimuth\n1,2\n", "has no column velocity"),
            ("range,azimuth,velocity\n1,2\n", "has too few columns in line 2"),
            ("range,azimuth,velocity\n\n1,NaN,2\n", "has no number in line 3, column azimuth"),
            ("range,azimuth,velocity\n1,0,inf\n", "has no number in line 2, column velocity"),
            (&long, "has over 100000 detections"),
        ] {
            assert_eq!(detections(table.as_bytes()).unwrap_err(), problem);
        }
        assert!(read_detections(b"range,\xff").is_err());
    }
}
