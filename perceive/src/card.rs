//! Model cards: how pictures go into a detector and what its numbers mean. ONNX does not say it.
//!
//! A network with the shapes of a known head has a card built in. A TOML file of the network's name beside it changes
//! the card; [`Written`] has its keys. One that would change nothing is refused.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Deserialize;

use crate::coco;
use crate::network::Shapes;

/// The largest side of a network's input, pixels.
const MAX_SIDE: usize = 4096;
/// Most bins of a side of a box.
const MAX_BINS: usize = 256;

/// How a detector is used.
#[derive(Debug, Clone, PartialEq)]
pub struct Card {
    /// Width and height of the input, pixels.
    pub input: [usize; 2],
    /// What the outputs mean.
    pub head: Head,
    /// Pixels of the input from anchor to anchor of each grid, finest first.
    pub strides: Vec<usize>,
    /// Where an anchor lies in its cell, in strides from the cell's upper left corner. Of NanoDet only.
    pub anchor: f32,
    /// Distances that each side of a box has a score for. Of NanoDet only.
    pub bins: usize,
    /// How a picture fills the input.
    pub resize: Resize,
    /// Order of the input's planes.
    pub channels: Channels,
    /// The input is (level − mean) / std, levels of 255, in the order of the planes.
    pub mean: [f32; 3],
    /// See [`mean`](Self::mean).
    pub std: [f32; 3],
    /// Grey level around the picture, of 255.
    pub pad: u8,
    /// Names of the network's classes.
    pub outputs: Vec<String>,
    /// Names of the detector's classes: those of the network, or what the card maps them to.
    pub classes: Vec<String>,
    /// For each of the network's classes the number of the detector's.
    pub class_of: Vec<usize>,
    /// Least score of a detection that counts, 0..1.
    pub score: f32,
    /// Largest overlap (intersection over union) of two boxes of a class.
    pub overlap: f32,
}

/// The keys of a card's file. Those that are left out have the values of the head.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Written {
    /// By default that which the network has the shapes of.
    pub head: Option<Head>,
    /// As in [`Card`].
    pub strides: Option<Vec<usize>>,
    /// As in [`Card`].
    pub anchor: Option<f32>,
    /// As in [`Card`].
    pub bins: Option<usize>,
    /// As in [`Card`].
    pub resize: Option<Resize>,
    /// As in [`Card`].
    pub channels: Option<Channels>,
    /// As in [`Card`].
    pub mean: Option<[f32; 3]>,
    /// As in [`Card`].
    pub std: Option<[f32; 3]>,
    /// As in [`Card`].
    pub pad: Option<u8>,
    /// Names of the network's classes; by default the 80 of COCO.
    pub classes: Option<Vec<String>>,
    /// New names of classes; those with the same name become one.
    pub map: BTreeMap<String, String>,
    /// As in [`Card`].
    pub score: Option<f32>,
    /// As in [`Card`].
    pub overlap: Option<f32>,
}

/// What a detector's outputs mean. C is the number of classes; all numbers of classes are in 0..1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Head {
    /// YOLOX (Ge et al. 2021), undecoded. anchors × (5 + C): centre as an offset in strides, log of the size in
    /// strides, objectness in 0..1, classes.
    Yolox,
    /// YOLOv8 and its followers as Ultralytics export them. (4 + C) × anchors: centre and size in pixels of the input,
    /// classes.
    Yolov8,
    /// FastestDet (dog-qiuqiu, 2022), one grid. (5 + C) × rows × columns: objectness in 0..1, tanh⁻¹ of the centre's
    /// offset in strides, logit of the size as a share of the input, classes.
    Fastestdet,
    /// NanoDet (RangiLyu, 2020) with its boxes as distributions (Li et al. 2020, generalized focal loss). anchors ×
    /// (C + 4 · bins): classes, then for the left, top, right and bottom the logits of 0, 1, … strides from the anchor.
    Nanodet,
}

/// How a picture fills an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Resize {
    /// In the upper left corner, its shape kept.
    Corner,
    /// In the middle, its shape kept.
    Centre,
    /// Wholly, its shape changed.
    Stretch,
}

/// Order of an input's planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Channels {
    /// Blue first, as OpenCV reads files.
    Bgr,
    /// Red first.
    Rgb,
}

impl Head {
    /// All heads, in the order in which a network is compared with them.
    pub const ALL: [Self; 4] = [Self::Yolox, Self::Yolov8, Self::Fastestdet, Self::Nanodet];

    /// As cards write it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Yolox => "yolox",
            Self::Yolov8 => "yolov8",
            Self::Fastestdet => "fastestdet",
            Self::Nanodet => "nanodet",
        }
    }

    /// Whether the output has a plane for each number of an anchor; else a row for each anchor.
    pub(crate) fn is_in_planes(self) -> bool {
        matches!(self, Self::Yolov8 | Self::Fastestdet)
    }

    /// How many numbers an anchor has; `classes` is the number of classes.
    pub(crate) fn numbers(self, classes: usize, bins: usize) -> usize {
        match self {
            Self::Yolox | Self::Fastestdet => 5 + classes,
            Self::Yolov8 => 4 + classes,
            Self::Nanodet => classes + 4 * bins,
        }
    }

    /// The output's sides after the first, which is 1, as text.
    fn sides(self, numbers: usize) -> String {
        match self {
            Self::Yolox | Self::Nanodet => format!("anchors×{numbers}"),
            Self::Yolov8 => format!("{numbers}×anchors"),
            Self::Fastestdet => format!("{numbers}×rows×columns"),
        }
    }
}

impl Card {
    /// The card of a network of these shapes; `written` is the TOML beside it, if there is one.
    ///
    /// # Errors
    /// TOML that is no card, values out of range, or shapes that do not fit the card.
    pub fn of(shapes: &Shapes, written: Option<&str>) -> Result<Self, String> {
        let bad = |problem: &str| format!("has a card beside it that cannot be used ({problem})");
        let written: Written = match written {
            Some(text) => {
                toml::from_str(text).map_err(|error| bad(error.message().lines().next().unwrap_or_default()))?
            }
            None => Written::default(),
        };
        let heads = written.head.map_or(Head::ALL.to_vec(), |head| vec![head]);
        let mut wanted = format!("has the shapes {shapes}, and a detector has 1×3×height×width in, out");
        for (i, head) in heads.into_iter().enumerate() {
            let mut card = Self::new(head, &written);
            card.check(&written.map).map_err(|problem| bad(&problem))?;
            if let Some(input) = card.input_of(shapes) {
                card.input = input;
                card.check_use(&written).map_err(|problem| bad(&problem))?;
                return Ok(card);
            }
            let (classes, name) = (card.outputs.len(), head.name());
            let or = if i > 0 { ", or" } else { "" };
            let _ =
                write!(wanted, "{or} 1×{} ({name} of {classes} classes)", head.sides(head.numbers(classes, card.bins)));
        }
        Err(wanted)
    }

    /// The card of a head, with what the file says, without the input's size.
    pub(crate) fn new(head: Head, written: &Written) -> Self {
        let strides: &[usize] = match head {
            Head::Yolox | Head::Yolov8 => &[8, 16, 32],
            Head::Fastestdet => &[16],
            Head::Nanodet => &[8, 16, 32, 64],
        };
        let (resize, channels) = match head {
            Head::Yolox => (Resize::Corner, Channels::Bgr),
            Head::Yolov8 => (Resize::Centre, Channels::Rgb),
            Head::Fastestdet | Head::Nanodet => (Resize::Stretch, Channels::Bgr),
        };
        let (mean, std) = match head {
            Head::Yolox => ([0.0; 3], [1.0; 3]),
            Head::Yolov8 | Head::Fastestdet => ([0.0; 3], [255.0; 3]),
            Head::Nanodet => ([103.53, 116.28, 123.675], [57.375, 57.12, 58.395]),
        };
        let outputs = written.classes.clone().unwrap_or_else(|| coco::NAMES.map(str::to_owned).to_vec());
        let (classes, class_of) = mapped(&outputs, &written.map);
        Self {
            input: [0; 2],
            head,
            strides: written.strides.clone().unwrap_or_else(|| strides.to_vec()),
            anchor: written.anchor.unwrap_or(0.0),
            bins: written.bins.unwrap_or(8),
            resize: written.resize.unwrap_or(resize),
            channels: written.channels.unwrap_or(channels),
            mean: written.mean.unwrap_or(mean),
            std: written.std.unwrap_or(std),
            pad: written.pad.unwrap_or(114),
            outputs,
            classes,
            class_of,
            score: written.score.unwrap_or(if head == Head::Fastestdet { 0.65 } else { 0.3 }),
            overlap: written.overlap.unwrap_or(0.45),
        }
    }

    /// The detector's class for what others call `name`: first as one of the network's classes, then of the
    /// detector's.
    pub fn class_named(&self, name: &str) -> Option<usize> {
        let output = self.outputs.iter().position(|of| of == name).map(|output| self.class_of[output]);
        output.or_else(|| self.classes.iter().position(|of| of == name))
    }

    /// Width and height of each grid of anchors, with its stride.
    pub(crate) fn grids(&self) -> impl Iterator<Item = (usize, [usize; 2])> {
        self.strides.iter().map(|&stride| (stride, self.input.map(|side| side.div_ceil(stride))))
    }

    /// The cells of all anchors in their order, grids from the first on, each by rows: side in pixels of the input,
    /// column and row.
    pub(crate) fn cells(&self) -> impl Iterator<Item = [usize; 3]> {
        self.grids()
            .flat_map(|(stride, [columns, rows])| (0..columns * rows).map(move |i| [stride, i % columns, i / columns]))
    }

    /// Size in pixels of the input of a picture of this size, and its upper left corner.
    pub(crate) fn area(&self, size: [usize; 2]) -> ([usize; 2], [usize; 2]) {
        let filled = if self.resize == Resize::Stretch { self.input } else { fitted(self.input, size) };
        let corner =
            |axis: usize| if self.resize == Resize::Centre { (self.input[axis] - filled[axis]) / 2 } else { 0 };
        (filled, [0, 1].map(corner))
    }

    /// Which of a picture's planes, red first, a plane of the input is.
    pub(crate) fn plane(&self, of_input: usize) -> usize {
        if self.channels == Channels::Bgr { 2 - of_input } else { of_input }
    }

    fn check(&self, map: &BTreeMap<String, String>) -> Result<(), String> {
        if let Some(key) = map.keys().find(|key| !self.outputs.contains(key)) {
            return Err(format!("it maps {key}, which is none of its classes"));
        }
        let is_share = |value: f32| (0.0..=1.0).contains(&value);
        let rules = [
            (!self.outputs.is_empty(), "it has no classes"),
            (!self.strides.is_empty() && !self.strides.contains(&0), "it has no strides, or one of 0"),
            (self.std.iter().all(|std| *std > 0.0 && std.is_finite()), "a std is not positive"),
            (self.mean.iter().all(|mean| mean.is_finite()), "a mean is no number"),
            (is_share(self.score) && is_share(self.overlap) && is_share(self.anchor), "a share is not in 0..1"),
            ((1..=MAX_BINS).contains(&self.bins), "bins are not in 1..256"),
        ];
        rules.into_iter().find(|(holds, _)| !holds).map_or(Ok(()), |(_, problem)| Err(problem.to_owned()))
    }

    /// Refuses keys that this card does not use.
    fn check_use(&self, written: &Written) -> Result<(), String> {
        for (key, is_written) in [("bins", written.bins.is_some()), ("anchor", written.anchor.is_some())] {
            if is_written && self.head != Head::Nanodet {
                return Err(format!("{key} changes nothing for {}: remove it", self.head.name()));
            }
        }
        if written.pad.is_some() && self.resize == Resize::Stretch {
            return Err("pad changes nothing where resize is stretch: remove it".to_owned());
        }
        Ok(())
    }

    /// Width and height of the input, if the shapes are those of this card.
    fn input_of(&self, shapes: &Shapes) -> Option<[usize; 2]> {
        let ([input], [output]) = (&shapes.inputs[..], &shapes.outputs[..]) else { return None };
        let &[Some(1), Some(3), Some(height), Some(width)] = &input[..] else { return None };
        if !(1..=MAX_SIDE).contains(&height) || !(1..=MAX_SIDE).contains(&width) {
            return None;
        }
        let input = [width, height];
        let grids: Vec<_> = Self { input, ..self.clone() }.grids().collect();
        let anchors = grids.iter().map(|(_, [columns, rows])| columns * rows).sum();
        let numbers = self.head.numbers(self.outputs.len(), self.bins);
        let expected = match (self.head, &grids[..]) {
            (Head::Yolox | Head::Nanodet, _) => vec![1, anchors, numbers],
            (Head::Yolov8, _) => vec![1, numbers, anchors],
            (Head::Fastestdet, &[(_, [columns, rows])]) => vec![1, numbers, rows, columns],
            (Head::Fastestdet, _) => return None,
        };
        output.iter().copied().eq(expected.into_iter().map(Some)).then_some(input)
    }
}

/// The names that classes are mapped to, in the order of their first class, and for each class the number of its name.
fn mapped(outputs: &[String], map: &BTreeMap<String, String>) -> (Vec<String>, Vec<usize>) {
    let mut names: Vec<String> = Vec::new();
    let mut number = |name: &String| {
        names.iter().position(|of| of == name).unwrap_or_else(|| {
            names.push(name.clone());
            names.len() - 1
        })
    };
    let class_of = outputs.iter().map(|output| number(map.get(output).unwrap_or(output))).collect();
    (names, class_of)
}

/// Width and height of a picture that is as large as fits; at least a pixel.
fn fitted([width, height]: [usize; 2], [w, h]: [usize; 2]) -> [usize; 2] {
    // In integers, so that the side that limits is hit exactly.
    if width * h <= height * w { [width, (h * width / w).max(1)] } else { [(w * height / h).max(1), height] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes(input: &[usize], output: &[usize]) -> Shapes {
        let all = |sides: &[usize]| vec![sides.iter().map(|&side| Some(side)).collect()];
        Shapes { inputs: all(input), outputs: all(output) }
    }

    #[test]
    fn heads_are_known_by_their_shapes() {
        for (head, side, output) in [
            (Head::Yolox, 416, &[1, 3549, 85][..]),
            (Head::Yolov8, 640, &[1, 84, 8400]),
            (Head::Fastestdet, 352, &[1, 85, 22, 22]),
            (Head::Nanodet, 416, &[1, 3598, 112]),
        ] {
            let card = Card::of(&shapes(&[1, 3, side, side], output), None).unwrap();
            assert_eq!((card.head, card.input, card.classes.len()), (head, [side, side], 80));
            assert_eq!((card.class_named("car"), card.class_named("lion")), (Some(2), None));
        }
        // Not square: width comes last.
        let wide = Card::of(&shapes(&[1, 3, 64, 96], &[1, 126, 85]), None).unwrap();
        assert_eq!(wide.input, [96, 64]);
        let no = |input: &[usize], output: &[usize]| Card::of(&shapes(input, output), None).unwrap_err();
        assert!(no(&[1, 3, 350, 350], &[1, 85, 20, 20]).contains("1×3×350×350 in, 1×85×20×20 out"));
        for (input, output) in [
            (&[1, 3, 416, 416], &[1, 3548, 85]),
            (&[1, 3, 416, 416], &[1, 3549, 86]),
            (&[2, 3, 416, 416], &[1, 3549, 85]),
            (&[1, 3, 420, 420], &[1, 3549, 85]),
            (&[1, 3, 0, 0], &[1, 0, 85]),
            (&[1, 3, 1 << 40, 1 << 40], &[1, 3549, 85]),
        ] {
            no(input, output);
        }
        let mut open = shapes(&[1, 3, 416, 416], &[1, 3549, 85]);
        open.outputs[0][1] = None;
        assert!(Card::of(&open, None).unwrap_err().contains("1×?×85"));
    }

    #[test]
    fn a_card_beside_the_network_overrides() {
        let two = shapes(&[1, 3, 64, 64], &[1, 80, 7]);
        let text = "strides = [8, 16]\nclasses = ['car', 'person']\nchannels = 'rgb'\nstd = [255, 255, 255]\npad = 0";
        let card = Card::of(&two, Some(text)).unwrap();
        assert_eq!((card.channels, card.std, card.head, card.pad), (Channels::Rgb, [255.0; 3], Head::Yolox, 0));
        for (bad, part) in [
            ("strides = []", "no strides"),
            ("strides = [0]", "no strides"),
            ("std = [1, 0, 1]", "std"),
            ("mean = [inf, 0, 0]", "mean"),
            ("score = 2.0", "0..1"),
            ("bins = 0", "bins"),
            ("head = 'fastestdet'\nstrides = [8, 16]", "85×rows×columns"),
            ("head = 'ssd'", "ssd"),
            ("colour = 'rgb'", "colour"),
            ("=", "cannot be used"),
            ("classes = []", "no classes"),
            ("[map]\nlion = 'cat'", "lion"),
            ("head = 'yolov8'", "84×anchors (yolov8 of 80 classes)"),
        ] {
            let error = Card::of(&two, Some(bad)).unwrap_err();
            assert!(!error.contains('\n') && error.contains(part), "{error}");
        }
    }

    #[test]
    fn keys_that_change_nothing_are_refused() {
        let yolox = shapes(&[1, 3, 416, 416], &[1, 3549, 85]);
        let fastestdet = shapes(&[1, 3, 352, 352], &[1, 85, 22, 22]);
        let nanodet = shapes(&[1, 3, 416, 416], &[1, 3598, 112]);
        for (shapes, idle, part) in [
            (&yolox, "bins = 8", "bins changes nothing for yolox: remove it"),
            (&yolox, "head = 'yolox'\nanchor = 0.5", "anchor changes nothing for yolox: remove it"),
            (&fastestdet, "bins = 16", "bins changes nothing for fastestdet"),
            (&fastestdet, "pad = 0", "pad changes nothing where resize is stretch"),
            (&yolox, "resize = 'stretch'\npad = 0", "pad changes nothing"),
            (&nanodet, "pad = 114", "pad changes nothing"),
        ] {
            let error = Card::of(shapes, Some(idle)).unwrap_err();
            assert!(!error.contains('\n') && error.contains(part), "{error}");
        }
        // The same keys where they are used; for another number of bins the head is told by its shape.
        let card = Card::of(&nanodet, Some("bins = 8\nanchor = 0.5\nresize = 'centre'\npad = 0")).unwrap();
        assert_eq!((card.bins, card.anchor, card.pad), (8, 0.5, 0));
        let wide = Card::of(&shapes(&[1, 3, 416, 416], &[1, 3598, 144]), Some("bins = 16")).unwrap();
        assert_eq!((wide.head, wide.bins), (Head::Nanodet, 16));
    }

    #[test]
    fn classes_are_renamed_and_joined() {
        let text = "classes = ['car', 'person', 'bus', 'dog']\n[map]\ncar = 'vehicle'\nbus = 'vehicle'\ndog = 'animal'";
        let card = Card::of(&shapes(&[1, 3, 64, 64], &[1, 84, 9]), Some(text)).unwrap();
        assert_eq!(
            (&card.classes[..], &card.class_of[..]),
            (&["vehicle", "person", "animal"].map(str::to_owned)[..], &[0, 1, 0, 2][..])
        );
        assert_eq!(
            ["bus", "vehicle", "animal", "cat"].map(|name| card.class_named(name)),
            [Some(0), Some(0), Some(2), None]
        );
    }

    #[test]
    fn the_side_that_limits_is_filled() {
        assert_eq!(fitted([416, 416], [1242, 375]), [416, 125]);
        assert_eq!(fitted([416, 416], [375, 1242]), [125, 416]);
        assert_eq!(fitted([416, 416], [480, 270]), [416, 234]);
        assert_eq!(fitted([96, 64], [3, 2]), [96, 64]);
        assert_eq!(fitted([416, 416], [60_000, 1]), [416, 1]);
    }
}
