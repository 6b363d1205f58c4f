//! The cases of `plat bench stability`: failures that methods of this field are known for, each with what plat has against it.
//!
//! Options are those of the command line, so every run of a case can be repeated by hand.

use std::fmt;

/// A capture on which methods fail.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Case {
    /// Its name on the command line and in lines.
    pub(crate) name: &'static str,
    /// What goes wrong, for the table.
    pub(crate) about: &'static str,
    /// Options of `plat synth` beside those of all cases.
    pub(crate) synth: &'static str,
    pub(crate) counter: Counter,
    /// Options of `plat train` without and with the counter-measure.
    pub(crate) train: [&'static str; 2],
    /// Options of `plat eval`.
    pub(crate) eval: &'static str,
    pub(crate) photos: MeasuredOn,
}

/// A counter-measure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Counter {
    /// None is known here; the case shows what the failure costs.
    Missing,
    /// Options of training.
    Options(&'static str),
    /// Options of training, without which it is refused.
    Enables(&'static str),
    /// The capture is refused.
    Refusal,
}

/// What photos and cameras the models are measured on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MeasuredOn {
    /// Those that they were trained on a part of.
    Own,
    /// Those without the fault.
    Clean,
}

impl Case {
    /// Whether a capture of one's own can show it: cameras that are wrong can only be told from the true ones.
    pub(crate) fn takes_captures(&self) -> bool {
        matches!(self.counter, Counter::Options(_)) && (self.photos == MeasuredOn::Own || self.eval == "--fit-exposure")
    }
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

impl Counter {
    /// Its name in the table.
    pub(crate) fn name(self) -> Option<&'static str> {
        match self {
            Self::Missing => None,
            Self::Options(name) | Self::Enables(name) => Some(name),
            Self::Refusal => Some("a check when it is opened"),
        }
    }
}

/// Target depths; of a capture without other sensors, those of its triangulated points. The last options of a case without its
/// counter-measure.
pub(crate) const DEPTHS: &str = "--depth-weight 0.1";
const LIDAR: Counter = Counter::Options("lidar: initial points and depths");
const LIDAR_TRAIN: [&str; 2] = ["--no-lidar --depth-weight 0.1", DEPTHS];
const RADAR: Counter = Counter::Options("radar: the road's initial points and depths");
const RADAR_TRAIN: [&str; 2] = ["--no-radar --depth-weight 0.1", DEPTHS];
const POSES: Counter = Counter::Options("poses refined");
const POSES_TRAIN: [&str; 2] = ["", "--refine-poses"];
const SENSORS: Counter = Counter::Options("sensors refined");
const SENSORS_TRAIN: [&str; 2] = ["", "--refine-sensors"];

/// A layout of streets, or a fault of light, that depths help with.
const fn depths(name: &'static str, about: &'static str, synth: &'static str) -> Case {
    let (counter, train, photos) = (LIDAR, LIDAR_TRAIN, MeasuredOn::Own);
    Case { name, about, synth, counter, train, eval: "--depth", photos }
}

/// A fault of light in which a radar sees what photos do not show.
const fn radar(name: &'static str, about: &'static str, synth: &'static str) -> Case {
    Case { name, about, synth, counter: RADAR, train: RADAR_TRAIN, eval: "--depth", photos: MeasuredOn::Own }
}

/// A fault of cameras, measured with the true ones.
const fn cameras(name: &'static str, about: &'static str, synth: &'static str) -> Case {
    let (counter, train, photos) = (POSES, POSES_TRAIN, MeasuredOn::Clean);
    Case { name, about, synth, counter, train, eval: "", photos }
}

/// A fault that all photos of a sensor share, measured with the true cameras.
const fn sensors(name: &'static str, about: &'static str, synth: &'static str) -> Case {
    let (counter, train, photos) = (SENSORS, SENSORS_TRAIN, MeasuredOn::Clean);
    Case { name, about, synth, counter, train, eval: "", photos }
}

/// A fault of pictures that nothing is done against, measured without it.
const fn pictures(name: &'static str, about: &'static str, synth: &'static str) -> Case {
    let (counter, train, photos) = (Counter::Missing, ["", ""], MeasuredOn::Clean);
    Case { name, about, synth, counter, train, eval: "", photos }
}

/// All cases.
pub(crate) const CASES: [Case; 26] = [
    Case {
        name: "no-depths",
        about: "nothing says how far the road is: it is painted on the backdrop",
        synth: "--truth",
        counter: Counter::Options("depths of sparse points"),
        train: ["", DEPTHS],
        eval: "--depth",
        photos: MeasuredOn::Own,
    },
    depths(
        "curved-corridor",
        "street that bends: every view is seen from few others",
        "--layout curved-corridor --lidar --truth",
    ),
    depths("alley", "walls a few metres away: large motion in the picture", "--layout alley --lidar --truth"),
    depths("winding", "winding road: short sight", "--layout winding --lidar --truth"),
    depths("deck", "road under a deck: two levels, little light", "--layout deck --lidar --truth"),
    depths(
        "textureless-road",
        "road of one colour: no points to start from",
        "--fault textureless-road --lidar --truth",
    ),
    depths("sparse-views", "six of ten photos are missing", "--fault sparse-views=0.67 --lidar --truth"),
    depths("sensor-dropout", "cameras and lidar are silent for seconds", "--fault sensor-dropout=0.6 --lidar --truth"),
    depths("night", "moonlight, lamps, grain", "--fault night --lidar --truth"),
    depths("rain", "wet ground and streaks", "--fault rain --lidar --truth"),
    depths("fog", "a visibility of 200 m", "--fault fog=0.5 --lidar --truth"),
    radar("radar-night", "moonlight, lamps, grain", "--fault night --radar --truth"),
    radar("radar-rain", "wet ground and streaks", "--fault rain --radar --truth"),
    radar("radar-fog", "a visibility of 200 m", "--fault fog=0.5 --radar --truth"),
    Case {
        name: "exposure-drift",
        about: "the gain wanders between photos",
        synth: "--fault exposure-drift=0.6",
        counter: Counter::Options("an exposure for each photo"),
        train: ["", "--exposure"],
        eval: "--fit-exposure",
        photos: MeasuredOn::Clean,
    },
    cameras("pose-noise", "poses off by 5 cm and 0.2°", "--fault pose-noise=0.1"),
    sensors("clock-skew", "cameras' clocks differ by 50 ms", "--fault clock-skew=0.5"),
    sensors(
        "wrong-calibration",
        "focal lengths off by 0.5 %, mounts by 1 cm and 0.1°",
        "--fault wrong-calibration=0.25",
    ),
    Case {
        name: "moving-unmasked",
        about: "moving objects in the photos",
        synth: "--traffic heavy",
        counter: Counter::Options("masks of what moves"),
        train: ["--no-masks", ""],
        eval: "",
        photos: MeasuredOn::Own,
    },
    Case {
        name: "sky",
        about: "the sky and the distance have no points",
        synth: "--truth",
        counter: Counter::Options("a backdrop: splats on a sphere"),
        train: ["--no-backdrop", ""],
        eval: "--depth",
        photos: MeasuredOn::Own,
    },
    pictures("motion-blur", "open for 1/30 s, on a shaking mount", "--fault motion-blur=0.5"),
    pictures("lens-dirt", "spots and a veil on the lenses", "--fault lens-dirt=0.6"),
    Case {
        name: "starved-blocks",
        about: "blocks that few photos see",
        synth: "--views 48 --plain 0.4",
        counter: Counter::Options("a tree: blocks start from their parent"),
        train: ["--blocks flat --levels 2", "--blocks tree --levels 2"],
        eval: "",
        photos: MeasuredOn::Own,
    },
    Case {
        name: "seams",
        about: "blocks trained apart differ at their faces",
        synth: "",
        counter: Counter::Options("a tree: blocks train beside their neighbours'"),
        train: ["--blocks flat --levels 1 --residual 0", "--blocks tree --levels 1 --residual 0"],
        eval: "--seams",
        photos: MeasuredOn::Own,
    },
    Case {
        name: "memory-cap",
        about: "a block wants more memory than there is",
        synth: "",
        counter: Counter::Enables("automatic levels: blocks that fit"),
        train: ["--levels 0 --budget 60000 --block-memory 160", "--levels auto --budget 60000 --block-memory 160"],
        eval: "",
        photos: MeasuredOn::Own,
    },
    Case {
        name: "nan-poses",
        about: "a pose that is not a number",
        synth: "",
        counter: Counter::Refusal,
        train: ["", ""],
        eval: "",
        photos: MeasuredOn::Own,
    },
];

/// The case of this name.
pub(crate) fn named(name: &str) -> Result<Case, String> {
    let names = || CASES.map(|case| case.name).join(", ");
    CASES.into_iter().find(|case| case.name == name).ok_or_else(|| format!("give one of {}", names()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cases_have_names_of_their_own_and_counter_measures_that_change_something() {
        for (i, case) in CASES.iter().enumerate() {
            assert_eq!(named(case.name).unwrap().about, case.about);
            assert!(CASES[..i].iter().all(|before| before.name != case.name), "{} is twice there", case.name);
            let changes_options = case.train[0] != case.train[1];
            let has_options = matches!(case.counter, Counter::Options(_) | Counter::Enables(_));
            assert_eq!(has_options, changes_options, "{}", case.name);
            assert!(case.photos == MeasuredOn::Own || case.synth.contains("--fault"), "{}", case.name);
        }
        assert!(named("hail").unwrap_err().contains("pose-noise"));
    }
}
