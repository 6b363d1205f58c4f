//! COLMAP's text files: one line per entry, two per image; `#` starts a comment.
//!
//! If COLMAP's comment states the number of entries, the file must have that many and end with a line break. This
//! detects truncated files.

use std::collections::BTreeMap;
use std::str::FromStr;

use glam::DVec3;

use super::model::{self, ColmapCamera, ColmapImage, ColmapPoints};
use crate::error::CodecError;

/// Reads `cameras.txt`.
///
/// # Errors
/// Malformed lines, unsupported lens models, parameters out of range.
pub fn read_cameras_txt(bytes: &[u8]) -> Result<BTreeMap<u32, ColmapCamera>, CodecError> {
    let mut cameras = BTreeMap::new();
    for (number, line) in lines(bytes)?.filter(|(_, line)| is_content(line)) {
        let mut words = Words { number, words: line.split_ascii_whitespace() };
        let (id, name) = (words.next()?, words.word()?);
        let (width, height) = (words.next()?, words.next()?);
        let parameters = words.rest()?;
        model::insert_camera(&mut cameras, id, model::camera(id, name, width, height, &parameters)?)?;
    }
    check_count(bytes, "cameras", cameras.len())?;
    Ok(cameras)
}

/// Reads `images.txt`.
///
/// # Errors
/// Malformed lines, images without a name or a finite pose.
pub fn read_images_txt(bytes: &[u8]) -> Result<Vec<ColmapImage>, CodecError> {
    let mut images = Vec::new();
    let mut lines = lines(bytes)?;
    while let Some((number, line)) = lines.next() {
        if !is_content(line) {
            continue;
        }
        let mut words = Words { number, words: line.split_ascii_whitespace() };
        let id = words.next()?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = words.next()?;
        }
        let camera_id = words.next()?;
        // The name is the rest of the line, as it may contain spaces.
        let mut name = line.trim_start();
        for _ in 0..9 {
            name = name.trim_start_matches(|c: char| !c.is_ascii_whitespace()).trim_start();
        }
        images.push(model::image(id, pose, camera_id, name.trim_end())?);
        // The next line has x, y and point id of each observation. It is present even if empty.
        let Some((number, line)) = lines.next() else {
            let problem =
                format!("is cut short: line {number} is the last, but an image has two (the second may be empty)");
            return Err(CodecError::new(problem));
        };
        if !line.split_ascii_whitespace().count().is_multiple_of(3) {
            return Err(CodecError::new(format!("line {number} is not a list of observations (x, y, point id)")));
        }
    }
    check_count(bytes, "images", images.len())?;
    model::check_unique_ids(images)
}

/// Reads `points3D.txt`.
///
/// # Errors
/// Malformed lines, positions that are not finite.
pub fn read_points_txt(bytes: &[u8]) -> Result<ColmapPoints, CodecError> {
    let mut points = ColmapPoints::default();
    for (number, line) in lines(bytes)?.filter(|(_, line)| is_content(line)) {
        let mut words = Words { number, words: line.split_ascii_whitespace() };
        let id = words.next()?;
        let position = DVec3::new(words.next()?, words.next()?, words.next()?);
        let colour = [words.next()?, words.next()?, words.next()?];
        let _reprojection_error: f64 = words.next()?;
        let track: Vec<u32> = words.rest()?;
        let (pairs, odd) = track.as_chunks::<2>();
        if !odd.is_empty() {
            return Err(CodecError::new(format!("line {number} ends within a track")));
        }
        points.push(id, position, colour, pairs.iter().map(|pair| pair[0]))?;
    }
    check_count(bytes, "points", points.len())?;
    Ok(points)
}

/// Lines with their numbers, from 1.
fn lines(bytes: &[u8]) -> Result<impl Iterator<Item = (usize, &str)>, CodecError> {
    let text = std::str::from_utf8(bytes).map_err(|_| CodecError::new("is not UTF-8 text"))?;
    Ok(text.lines().enumerate().map(|(i, line)| (i + 1, line)))
}

/// Compares `count` with a leading comment such as `# Number of images: 50, mean observations per image: 9.5`, if there
/// is one.
fn check_count(bytes: &[u8], what: &str, count: usize) -> Result<(), CodecError> {
    let comments = lines(bytes)?.take_while(|(_, line)| !is_content(line));
    let stated = comments.filter_map(|(_, line)| {
        let rest = line.trim_start_matches(['#', ' ']).strip_prefix("Number of ")?.strip_prefix(what)?;
        rest.strip_prefix(':')?.split(',').next()?.trim().parse::<usize>().ok()
    });
    match stated.last() {
        Some(stated) if stated != count => Err(CodecError::new(format!(
            "is cut short or was edited: its comment states {stated} {what}, the file has {count}"
        ))),
        Some(_) if !bytes.ends_with(b"\n") => Err(CodecError::new("is cut short: its last line has no line break")),
        _ => Ok(()),
    }
}

fn is_content(line: &str) -> bool {
    let line = line.trim_start();
    !line.is_empty() && !line.starts_with('#')
}

struct Words<'a> {
    number: usize,
    words: std::str::SplitAsciiWhitespace<'a>,
}

impl<'a> Words<'a> {
    fn word(&mut self) -> Result<&'a str, CodecError> {
        self.words.next().ok_or_else(|| CodecError::new(format!("line {} is cut short", self.number)))
    }

    fn next<T: FromStr>(&mut self) -> Result<T, CodecError> {
        let word = self.word()?;
        self.parse(word)
    }

    fn rest<T: FromStr>(mut self) -> Result<Vec<T>, CodecError> {
        let mut values = Vec::new();
        while let Some(word) = self.words.next() {
            values.push(self.parse(word)?);
        }
        Ok(values)
    }

    fn parse<T: FromStr>(&self, word: &str) -> Result<T, CodecError> {
        word.parse().map_err(|_| {
            let word: String = word.escape_debug().take(40).collect();
            CodecError::new(format!("line {}: '{word}' is not a valid number here", self.number))
        })
    }
}
