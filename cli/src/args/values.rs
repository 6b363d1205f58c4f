//! Types and parsers of option values.

use std::fmt;
use std::str::FromStr;

use clap::ValueEnum;
use clap::builder::TypedValueParser;
use eval::Levels;
use glam::DVec3;
use serde::{Serialize, Serializer};
use train::importance::Order;

/// A value, or `auto` to let the program choose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Auto<T>(pub(crate) Option<T>);

impl<T: FromStr> FromStr for Auto<T> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self(None)),
            text => text.parse().map(|value| Self(Some(value))).map_err(|_| "give a whole number or auto".into()),
        }
    }
}

impl<T: fmt::Display> fmt::Display for Auto<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(value) => value.fmt(f),
            None => f.write_str("auto"),
        }
    }
}

impl<T: Serialize> Serialize for Auto<T> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match &self.0 {
            Some(value) => value.serialize(to),
            None => to.serialize_str("auto"),
        }
    }
}

/// A shift of an object, written `ID=X,Y,Z` or `ID=X,Y,Z,DEGREES`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ObjectMove {
    pub(crate) id: String,
    /// Metres in the world.
    pub(crate) metres: DVec3,
    /// Around its own vertical axis, to the left.
    pub(crate) degrees: f64,
}

impl FromStr for ObjectMove {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = |text| numbers::<3>(text).map(|[x, y, z]| [x, y, z, 0.0]).or_else(|| numbers::<4>(text));
        match text.split_once('=').and_then(|(id, rest)| Some((id, numbers(rest)?))) {
            Some((id, [x, y, z, degrees])) => Ok(Self { id: id.to_owned(), metres: DVec3::new(x, y, z), degrees }),
            _ => Err("give ID=X,Y,Z or ID=X,Y,Z,DEGREES, such as 160=2.5,0,0".into()),
        }
    }
}

/// So many numbers with commas between them, each finite and under a million.
pub(crate) fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Vec<f64> = text.split(',').map(|part| part.trim().parse().ok()).collect::<Option<_>>()?;
    let is_sane = numbers.iter().all(|number| number.is_finite() && number.abs() < 1e6);
    numbers.try_into().ok().filter(|_| is_sane)
}

/// A time in seconds.
pub(crate) fn clock_seconds(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| "give seconds, such as 2.5".into())
}

/// Width and height in pixels, written `640x480`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

/// Longest side of a rendered picture, pixels.
const MAX_SIDE: u32 = 16_384;

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let side = |text: &str| text.parse().ok().filter(|side| (1..=MAX_SIDE).contains(side));
        let sides = text.split_once('x').and_then(|(w, h)| Some((side(w)?, side(h)?)));
        let (width, height) = sides.ok_or_else(|| format!("give it as 640x480, sides from 1 to {MAX_SIDE}"))?;
        Ok(Self { width, height })
    }
}

/// What trains or renders.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Backend {
    /// A GPU with memory of its own, else the CPU; for `plat submit` the backend of most workers
    #[default]
    Auto,
    /// SIMD and threads
    Cpu,
    /// Vulkan, Metal or DirectX 12; PLAT_GPU_ADAPTER chooses an adapter by a part of its name
    Gpu,
}

pub(super) fn minutes(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|minutes: &f64| *minutes > 0.0 && minutes.is_finite());
    value.ok_or_else(|| "give minutes above 0, such as 30 or 0.5".into())
}

pub(super) fn metres(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|metres: &f64| *metres > 0.0 && metres.is_finite());
    value.ok_or_else(|| "give metres above 0, such as 2 or 0.5".into())
}

pub(super) fn metres_or_none(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|metres: &f64| *metres >= 0.0 && metres.is_finite());
    value.ok_or_else(|| "give metres from 0, such as 50".into())
}

/// A level of the tree, or `all`.
pub(super) fn levels(text: &str) -> Result<Levels, String> {
    match text {
        "all" => Ok(Levels::All),
        text => text.parse().map(Levels::Only).map_err(|_| "give a level from 0, or all".into()),
    }
}

pub(super) fn views_per_step() -> impl TypedValueParser<Value = u32> {
    clap::value_parser!(u32).range(1..=i64::from(blocks::MAX_VIEWS_PER_STEP))
}

pub(super) fn share(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|share: &f64| *share > 0.0 && *share <= 1.0);
    value.ok_or_else(|| "give a share above 0 and at most 1, such as 0.5".into())
}

pub(super) fn newest(text: &str) -> Result<f64, String> {
    share(text).map_err(|_| "give the share of the newest picture, above 0 and at most 1, such as 0.6".into())
}

pub(super) fn rate(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|rate: &f64| (0.1..=240.0).contains(rate));
    value.ok_or_else(|| "give pictures a second from 0.1 to 240, such as 25".into())
}

pub(super) fn share_from_zero(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|share: &f64| (0.0..=1.0).contains(share));
    value.ok_or_else(|| "give a share from 0 to 1, such as 0.05".into())
}

pub(super) fn seconds(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|seconds: &f64| *seconds >= 0.0 && seconds.is_finite());
    value.ok_or_else(|| "give seconds from 0, such as 60".into())
}

pub(super) fn decibels(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|db: &f64| *db >= 0.0 && db.is_finite());
    value.ok_or_else(|| "give decibels from 0, such as 0.1".into())
}

pub(super) fn weight(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|weight: &f64| *weight >= 0.0 && weight.is_finite());
    value.ok_or_else(|| "give a weight from 0, such as 0.1".into())
}

pub(super) fn aligned_weight(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|weight: &f64| (0.0..=1000.0).contains(weight));
    value.ok_or_else(|| "give a weight from 0 to 1000, such as 0.1".into())
}

pub(super) fn residual(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|share: &f64| (0.0..1.0).contains(share));
    value.ok_or_else(|| "give a share from 0 to 1, such as 0.25".into())
}

pub(super) fn order(text: &str) -> Result<Order, String> {
    let names = || Order::ALL.map(Order::name).join(", ");
    Order::ALL.into_iter().find(|order| order.name() == text).ok_or_else(|| format!("give one of {}", names()))
}
