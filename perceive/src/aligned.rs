//! The perception-aligned loss: a render shall let a frozen detector see what it sees in the photo.
//!
//! After equations 4 to 6 of "Beyond visual reconstruction quality: object perception-aware 3D Gaussian splatting for
//! autonomous driving": λ_box · (1 − mean CIoU) + λ_class · class disagreement, over the objects that the detector finds
//! in the photo. The paper leaves open which numbers of the render belong to an object, and its class term (the share of
//! objects with another class) has no derivative. Here:
//!
//! - An object is what non-maximum suppression keeps of the photo, with the anchors that it merged into that, weighted
//!   by their scores on the photo. The render is read at the same anchors, whatever is found there. So the assignment
//!   neither changes between steps nor ends where the render loses an object, which is where the gradient is needed.
//! - Each anchor is compared with itself on the photo. The loss of the photo itself is 0.
//! - Classes disagree by Σ over classes of the Kullback-Leibler divergence of the render's score from the photo's, each
//!   a probability of its own: binary cross-entropy less its least value, which no render can lower.
//!
//! Objects that only the render shows do not count, as in the paper.

mod anchors;
mod ciou;
mod planes;
#[cfg(test)]
mod tests;

use scene::BadInput;

use crate::boxes::{MAX_BOXES, iou};
use crate::card::Card;
use crate::gradient::{Activations, Network};
use crate::network::Shapes;
use anchors::{Anchor, Anchors};
use ciou::ciou;
use planes::Placement;

const ADVICE: &str = "give a detector of convolutions as an ONNX file of fixed sizes with a model card that fits";
/// Scores are compared within this distance of 0 and 1.
const LEAST: f64 = 1e-7;

/// A frozen detector as a loss.
pub struct Aligned {
    file: String,
    network: Network,
    card: Card,
    weights: Weights,
}

/// Weights of the terms, λ of equation 4.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weights {
    /// Of 1 − mean CIoU.
    pub boxes: f64,
    /// Of the disagreement of classes.
    pub classes: f64,
}

impl Default for Weights {
    /// Those of the paper.
    fn default() -> Self {
        Self { boxes: 1.0, classes: 1.0 }
    }
}

/// What the detector sees in a photo: a few hundred numbers for each object.
#[derive(Debug, Clone, PartialEq)]
pub struct Targets {
    size: [usize; 2],
    objects: Vec<Object>,
}

/// An object in a photo.
#[derive(Debug, Clone, PartialEq)]
struct Object {
    /// The anchors that saw it: number, weight (their sum is 1), and what they said.
    anchors: Vec<(usize, f64, Anchor)>,
}

/// The loss of a render.
#[derive(Debug, Clone, PartialEq)]
pub struct Loss {
    /// The weighted sum of both terms.
    pub total: f64,
    /// 1 − mean CIoU of the objects.
    pub boxes: f64,
    /// Mean disagreement of the objects' classes, nats.
    pub classes: f64,
    /// Derivative of the total with respect to the render: three planes.
    pub gradient: Vec<f32>,
}

impl Targets {
    /// Number of objects.
    pub fn len(&self) -> usize {
        self.objects.len()
    }

    /// Whether the photo shows no object: every render's loss is 0.
    pub fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// Keeps the objects for whose box (left, top, right, bottom in pixels of the photo, not cut at its edges) this holds.
    pub fn retain(&mut self, mut holds: impl FnMut([f32; 4]) -> bool) {
        // The best anchor is the first.
        self.objects.retain(|object| holds(object.anchors[0].2.corners.map(|corner| corner as f32)));
    }

    /// Size in memory, bytes.
    pub fn bytes(&self) -> usize {
        let anchors = self.objects.iter().flat_map(|object| &object.anchors);
        let scores: usize = anchors.clone().map(|(.., anchor)| size_of_val(&anchor.scores[..])).sum();
        size_of::<Self>()
            + size_of_val(&self.objects[..])
            + anchors.count() * size_of::<(usize, f64, Anchor)>()
            + scores
    }
}

impl Aligned {
    /// Loads a detector from the bytes of its ONNX file; `card` is the text of the TOML file beside it, if there is
    /// one.
    ///
    /// # Errors
    /// Bytes that are no ONNX graph, one with operators whose gradient is not known, or one that does not fit its card.
    pub fn new(file: &str, bytes: &[u8], card: Option<&str>, weights: Weights) -> Result<Self, BadInput> {
        let bad = |problem: String| BadInput::new(file, problem, ADVICE);
        let network = Network::load(bytes).map_err(bad)?;
        let sides = |shape: &[usize]| vec![shape.iter().map(|&side| Some(side)).collect()];
        let shapes = Shapes { inputs: sides(network.input_shape()), outputs: sides(network.output_shape()) };
        let card = Card::of(&shapes, card).map_err(bad)?;
        Ok(Self { file: file.to_owned(), network, card, weights })
    }

    /// How pictures go in and what comes out.
    pub fn card(&self) -> &Card {
        &self.card
    }

    /// What the detector sees in a photo of three planes, red first, 0..1. `memory` is kept from call to call.
    ///
    /// # Errors
    /// Planes that are not of `width` × `height` pixels, or none.
    pub fn targets(
        &self,
        photo: &[f32],
        width: usize,
        height: usize,
        memory: &mut Activations,
    ) -> Result<Targets, BadInput> {
        let placement = self.placement(photo, [width, height])?;
        let anchors = Anchors::new(&self.card, placement.placed());
        let output = self.network.forward(&placement.forward(photo), memory);
        Ok(Targets { size: [width, height], objects: objects(&anchors, output, &self.card) })
    }

    /// The loss of a render of three planes, red first, 0..1, and its gradient. Where the detector's numbers for the
    /// render are not finite, the gradient is 0.
    ///
    /// # Errors
    /// Planes that are not of `width` × `height` pixels, or targets of a photo of another size.
    pub fn loss(
        &self,
        render: &[f32],
        width: usize,
        height: usize,
        targets: &Targets,
        memory: &mut Activations,
    ) -> Result<Loss, BadInput> {
        let placement = self.placement(render, [width, height])?;
        if targets.size != [width, height] {
            let [w, h] = targets.size;
            return Err(self.bad(format!("is given a render of {width}×{height} pixels for a photo of {w}×{h}")));
        }
        let mut loss = Loss { total: 0.0, boxes: 0.0, classes: 0.0, gradient: vec![0.0; render.len()] };
        if targets.is_empty() {
            return Ok(loss);
        }
        let anchors = Anchors::new(&self.card, placement.placed());
        let output = self.network.forward(&placement.forward(render), memory);
        let mut gradient = vec![0.0; output.len()];
        for object in &targets.objects {
            for (anchor, weight, photo) in &object.anchors {
                let share = weight / targets.len() as f64;
                let seen = anchors.read(output, *anchor);
                let (overlap, slopes) = ciou(photo.corners, seen.corners);
                loss.boxes += share * (1.0 - overlap);
                let corners = slopes.map(|slope| -self.weights.boxes * share * slope);
                let differ = photo.scores.iter().zip(&seen.scores).map(|(&p, &q)| divergence(p, q));
                let (values, slopes): (Vec<f64>, Vec<f64>) = differ.unzip();
                loss.classes += share * values.iter().sum::<f64>();
                let scores = slopes.iter().map(|slope| self.weights.classes * share * slope).collect();
                anchors.pull(output, *anchor, &Anchor { corners, scores }, &mut gradient);
            }
        }
        loss.total = self.weights.boxes * loss.boxes + self.weights.classes * loss.classes;
        if loss.total.is_finite() && gradient.iter().all(|slope| slope.is_finite()) {
            loss.gradient = placement.backward(&self.network.backward(memory, &gradient));
        }
        Ok(loss)
    }

    fn bad(&self, problem: String) -> BadInput {
        BadInput::new(self.file.clone(), problem, ADVICE)
    }

    fn placement(&self, planes: &[f32], size: [usize; 2]) -> Result<Placement, BadInput> {
        let [width, height] = size;
        let count = width.checked_mul(height).and_then(|area| area.checked_mul(3));
        if planes.is_empty() || count != Some(planes.len()) {
            let numbers = planes.len();
            return Err(self.bad(format!("is given a picture of {width}×{height} pixels in {numbers} numbers")));
        }
        Ok(Placement::new(size, &self.card))
    }
}

/// The objects in a photo, best first: non-maximum suppression by the detector's classes, as
/// [`suppressed`](crate::boxes) does it, that remembers what is suppressed by what.
fn objects(anchors: &Anchors, output: &[f32], card: &Card) -> Vec<Object> {
    struct Found {
        number: usize,
        class: usize,
        score: f64,
        anchor: Anchor,
    }
    let found = |number: usize| {
        let anchor = anchors.read(output, number);
        let classes = anchor.scores.iter().copied().enumerate();
        let (best, score) = classes.reduce(|best, next| if next.1 > best.1 { next } else { best })?;
        let is_finite = anchor.corners.iter().chain(&anchor.scores).all(|number| number.is_finite());
        let class = card.class_of[best];
        let is_there = (0..2).all(|i| {
            let [start, end] = [anchor.corners[i], anchor.corners[i + 2]];
            start.max(0.0) < end.min(anchors.size()[i])
        });
        (is_finite && is_there && score >= f64::from(card.score)).then_some(Found { number, class, score, anchor })
    };
    let mut all: Vec<Found> = (0..anchors.count()).filter_map(found).collect();
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    all.truncate(MAX_BOXES);
    let corners = |of: &Found| of.anchor.corners.map(|corner| corner as f32);
    let mut groups: Vec<Vec<Found>> = Vec::new();
    for next in all {
        let is_same = |best: &Found| best.class == next.class && iou(corners(best), corners(&next)) > card.overlap;
        match groups.iter_mut().find(|group| is_same(&group[0])) {
            Some(group) => group.push(next),
            None => groups.push(vec![next]),
        }
    }
    let object = |group: Vec<Found>| {
        let sum: f64 = group.iter().map(|found| found.score).sum();
        Object { anchors: group.into_iter().map(|found| (found.number, found.score / sum, found.anchor)).collect() }
    };
    groups.into_iter().map(object).collect()
}

/// Kullback-Leibler divergence of probability `q` from `p`, nats, and its derivative by `q`. Beyond the least and
/// greatest score the derivative is that at these.
fn divergence(p: f64, q: f64) -> (f64, f64) {
    let [p, q] = [p, q].map(|score| score.clamp(LEAST, 1.0 - LEAST));
    let value = p * (p / q).ln() + (1.0 - p) * ((1.0 - p) / (1.0 - q)).ln();
    (value, (q - p) / (q * (1.0 - q)))
}
