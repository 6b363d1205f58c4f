//! Model cards: how pictures go into a detector and what its numbers mean. ONNX does not say it.
//!
//! A network with the shapes of YOLOX has a card built in. A TOML file of the network's name beside it changes the
//! card:
//!
//! ```toml
//! head = "yolox"            # the only one so far
//! strides = [8, 16, 32]     # pixels of the input from anchor to anchor, finest grid first
//! channels = "bgr"          # or "rgb"
//! white = 255.0             # the value of a white pixel; black is 0
//! pad = 114                 # grey level around the picture, of 255
//! classes = ["person", …]   # by default the 80 of COCO
//! ```

use serde::Deserialize;

use crate::coco;
use crate::network::Shapes;

/// The largest side of a network's input, pixels.
const MAX_SIDE: usize = 4096;
/// Numbers of an anchor before those of its classes: centre, size, and how likely it is an object.
pub(crate) const BOX_NUMBERS: usize = 5;

/// How a detector is used.
#[derive(Debug, Clone, PartialEq)]
pub struct Card {
    /// Width and height of the input, pixels.
    pub input: [usize; 2],
    /// As in the file.
    pub written: Written,
}

/// What the file beside the network can say.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Written {
    /// What the outputs mean.
    pub head: Head,
    /// Pixels of the input from anchor to anchor of each grid, finest first.
    pub strides: Vec<usize>,
    /// Order of the input's planes.
    pub channels: Channels,
    /// Value of a white pixel.
    pub white: f32,
    /// Grey level around the picture, of 255.
    pub pad: u8,
    /// Names of the classes.
    pub classes: Vec<String>,
}

impl Default for Written {
    /// YOLOX as trained on COCO (Ge et al. 2021).
    fn default() -> Self {
        Self {
            head: Head::Yolox,
            strides: vec![8, 16, 32],
            channels: Channels::Bgr,
            white: 255.0,
            pad: 114,
            classes: coco::NAMES.map(str::to_owned).to_vec(),
        }
    }
}

/// What a detector's outputs mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Head {
    /// A row an anchor: centre as an offset in strides, log of the size in strides, objectness, and classes, both in
    /// 0..1.
    Yolox,
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

impl Card {
    /// The card of a network of these shapes; `written` is the TOML beside it, if there is one.
    ///
    /// # Errors
    /// TOML that is no card, or shapes that do not fit the card.
    pub fn of(shapes: &Shapes, written: Option<&str>) -> Result<Self, String> {
        let card: Written = match written {
            Some(text) => toml::from_str(text).map_err(|error| {
                let line = error.message().lines().next().unwrap_or_default().to_owned();
                format!("has a card beside it that cannot be used ({line})")
            })?,
            None => Written::default(),
        };
        if card.strides.is_empty() || card.strides.contains(&0) || !card.white.is_finite() || card.white <= 0.0 {
            return Err("has a card beside it without strides, or with a stride or white that is not positive".into());
        }
        let wanted = || {
            let classes = card.classes.len();
            let all = BOX_NUMBERS + classes;
            format!("has the shapes {shapes}, and YOLOX of {classes} classes has 1×3×H×W in, 1×anchors×{all} out")
        };
        let ([input], [output]) = (&shapes.inputs[..], &shapes.outputs[..]) else { return Err(wanted()) };
        let (&[Some(1), Some(3), Some(height), Some(width)], &[Some(1), Some(anchors), Some(numbers)]) =
            (&input[..], &output[..])
        else {
            return Err(wanted());
        };
        if !(1..=MAX_SIDE).contains(&height) || !(1..=MAX_SIDE).contains(&width) {
            return Err(wanted());
        }
        let expected: usize = card.strides.iter().map(|stride| (height / stride) * (width / stride)).sum();
        let is_even = card.strides.iter().all(|stride| height.is_multiple_of(*stride) && width.is_multiple_of(*stride));
        if !is_even
            || anchors != expected
            || anchors == 0
            || numbers != BOX_NUMBERS + card.classes.len()
            || numbers == BOX_NUMBERS
        {
            return Err(wanted());
        }
        Ok(Self { input: [width, height], written: card })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes(input: &[usize], output: &[usize]) -> Shapes {
        let all = |sides: &[usize]| vec![sides.iter().map(|&side| Some(side)).collect()];
        Shapes { inputs: all(input), outputs: all(output) }
    }

    #[test]
    fn yolox_is_known_by_its_shapes() {
        let card = Card::of(&shapes(&[1, 3, 416, 416], &[1, 3549, 85]), None).unwrap();
        assert_eq!((card.input, card.written.classes.len(), card.written.pad), ([416, 416], 80, 114));
        // Not square: width comes last.
        let wide = Card::of(&shapes(&[1, 3, 64, 96], &[1, 126, 85]), None).unwrap();
        assert_eq!(wide.input, [96, 64]);
        let no = |input: &[usize], output: &[usize]| Card::of(&shapes(input, output), None).unwrap_err();
        assert!(no(&[1, 3, 352, 352], &[1, 85, 22, 22]).contains("1×3×352×352 in, 1×85×22×22 out"));
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
        let text = "strides = [8, 16]\nclasses = ['car', 'person']\nchannels = 'rgb'\nwhite = 1.0\npad = 0";
        let card = Card::of(&two, Some(text)).unwrap();
        assert_eq!((card.written.channels, card.written.white, card.written.head), (Channels::Rgb, 1.0, Head::Yolox));
        for bad in [
            "strides = []",
            "strides = [0]",
            "white = 0.0",
            "white = inf",
            "head = 'ssd'",
            "colour = 'rgb'",
            "=",
            "classes = []",
        ] {
            let error = Card::of(&two, Some(bad)).unwrap_err();
            assert!(!error.contains('\n'), "{error}");
        }
    }
}
