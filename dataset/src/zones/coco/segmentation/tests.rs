use super::*;

fn parsed(text: &str) -> Segmentation {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// The mask of a photo as rows of `#` and `.`.
fn drawn(text: &str, size: [u32; 2], photo: [u32; 2]) -> Vec<String> {
    let (mask, _) = parsed(text).mask(size, photo).unwrap().unwrap();
    let mut rows = vec![vec![b'.'; photo[0] as usize]; photo[1] as usize];
    mask.spans(photo[0]).for_each(|(y, x)| rows[y as usize][x.start as usize..x.end as usize].fill(b'#'));
    rows.into_iter().map(|row| String::from_utf8(row).unwrap()).collect()
}

#[test]
fn polygons_cover_the_pixels_whose_centres_they_contain() {
    let square = "[[1, 1, 4, 1, 4, 3, 1, 3]]";
    assert_eq!(drawn(square, [6, 4], [6, 4]), ["......", ".###..", ".###..", "......"]);
    assert_eq!(drawn(square, [6, 4], [12, 8])[1..4], ["............", "..######....", "..######...."]);
    assert_eq!(drawn(square, [6, 4], [3, 2]), ["##.", "..."]);
    assert_eq!(drawn("[[0, 0, 6, 0, 0, 4]]", [6, 4], [6, 4]), ["#####.", "####..", "##....", "#....."]);
    // Two parts, of which one overlaps the other, and a part without area.
    let parts = "[[0, 0, 3, 0, 3, 2, 0, 2], [2, 1, 5, 1, 5, 3, 2, 3], [1, 1, 2, 2]]";
    assert_eq!(drawn(parts, [6, 4], [6, 4]), ["###...", "#####.", "..###.", "......"]);
    // A pixel beyond the edge is cut off; a speck has no pixel.
    assert_eq!(drawn("[[-1, -1, 1, -1, 1, 5, -1, 5]]", [2, 4], [2, 4]), ["#.", "#.", "#.", "#."]);
    assert_eq!(parsed("[[1.1, 1.1, 1.2, 1.1, 1.2, 1.2]]").mask([6, 4], [6, 4]).unwrap(), None);
    assert!(parsed("[]").is_empty() && parsed("[[1, 2]]").is_empty() && !parsed(square).is_empty());
}

#[test]
fn run_lengths_go_by_columns() {
    let shape = ["......", ".##...", ".#....", ".....#"];
    // 5 outside, 2 inside, 2 outside, 1 inside, 13 outside, 1 inside.
    let plain = r#"{"size": [4, 6], "counts": [5, 2, 2, 1, 13, 1]}"#;
    assert_eq!(drawn(plain, [6, 4], [6, 4]), shape);
    // As pycocotools writes the same pixels: 5, 2, 2, 1 - 2, 13 - 2, 1 - 1.
    assert_eq!(decompressed("522O;0").unwrap(), [5, 2, 2, 1, 13, 1]);
    let compressed = r#"{"counts": "522O;0", "more": [1, {}], "size": [4, 6]}"#;
    assert_eq!(drawn(compressed, [6, 4], [6, 4]), shape);
    // At twice and half the size.
    assert_eq!(drawn(plain, [6, 4], [12, 8])[2..4], ["..####......"; 2]);
    assert_eq!(drawn(r#"{"size": [4, 4], "counts": [0, 16]}"#, [4, 4], [2, 2]), ["##", "##"]);
    assert_eq!(parsed(r#"{"size": [4, 6], "counts": [24]}"#).mask([6, 4], [6, 4]).unwrap(), None);
    // 1,000 = 8 + 31 · 32, and a letter more for the sign.
    assert_eq!(decompressed("Xo0").unwrap(), [1000]);
}

#[test]
fn what_is_no_mask_is_refused() {
    let refused = |text: &str, says: &str| {
        let line = parsed(text).mask([6, 4], [6, 4]).unwrap_err().to_string();
        assert!(line.contains(says), "{line}");
    };
    refused("[[0, 0, 9, 0, 0, 4]]", "9, 0 outside");
    refused("[[0, 0, 1e30, 0, 0, 4]]", "outside");
    refused("[[0, 0, 4, 0, 0, 4, 1]]", "without its y");
    refused(r#"{"size": [6, 4], "counts": [24]}"#, "of 4×6 pixels, its image 6×4");
    refused(r#"{"size": [4, 6], "counts": [23]}"#, "23 pixels in all, its image 24");
    refused(r#"{"size": [4, 6], "counts": [4294967295, 4294967295, 26]}"#, "pixels in all");
    for text in ["o", "oooooooooo0", "5\u{e9}", "5 2", "O", "~"] {
        refused(&format!(r#"{{"size": [4, 6], "counts": "{text}"}}"#), "damaged string");
    }
    let zigzag: Vec<String> = (0..600_000).map(|i| format!("{},{}", i % 6, i % 2 * 4)).collect();
    refused(&format!("[[{}]]", zigzag.join(",")), "wind too often");
    for text in [
        "3",
        "\"a\"",
        "[3]",
        "[[null, 1]]",
        "[[NaN, 1]]",
        "[[1e300, 1]]",
        "{}",
        r#"{"size": [4, 6]}"#,
        r#"{"counts": [24]}"#,
    ] {
        assert!(serde_json::from_str::<Segmentation>(text).is_err(), "{text}");
    }
    for counts in ["[-1]", "[1.5]", "[4294967296]", "null", "{}"] {
        assert!(serde_json::from_str::<Segmentation>(&format!(r#"{{"size": [4, 6], "counts": {counts}}}"#)).is_err());
    }
}
