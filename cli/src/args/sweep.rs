//! The command line of a sweep: the options of `plat train`, some of which take a list.

use std::path::PathBuf;

use clap::{Arg, ArgAction, ArgMatches, Args, Command, Error, FromArgMatches};

use super::TrainArgs;
use super::values::{Auto, Backend};

/// The runs of a sweep: every combination of captures and option values.
#[derive(Debug, Clone)]
pub(crate) struct Sweep {
    pub(crate) captures: Vec<Named>,
    pub(crate) steps: Vec<Auto<u32>>,
    pub(crate) budget: Vec<Auto<u32>>,
    pub(crate) tolerance_db: Vec<f64>,
    pub(crate) backend: Vec<Backend>,
    pub(crate) seed: Vec<u64>,
    /// Options of `plat train` with the first capture and the first values.
    pub(crate) train: TrainArgs,
}

/// A capture with its name in chart and table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Named {
    /// `None` if it was not given.
    pub(crate) name: Option<String>,
    pub(crate) path: PathBuf,
}

impl From<PathBuf> for Named {
    /// Parses `NAME=PATH` or a path alone.
    fn from(path: PathBuf) -> Self {
        match path.to_str().and_then(|text| text.split_once('=')) {
            Some((name, path)) if !name.is_empty() => Self { name: Some(name.into()), path: path.into() },
            _ => Self { name: None, path },
        }
    }
}

impl Args for Sweep {
    fn augment_args(command: Command) -> Command {
        let list = |arg: Arg| arg.value_delimiter(',');
        let mut command = TrainArgs::augment_args(command).mut_arg("capture", |arg| {
            let help = "Folders of captures (COLMAP, transforms.json, OpenSfM, DGP, nuScenes, KITTI, KITTI-360, KITTI raw or Waymo), each with its name in the chart; by default that of its folder";
            arg.action(ArgAction::Append).num_args(1..).value_name("NAME=PATH").help(help)
        });
        for id in ["steps", "budget", "tolerance_db", "backend", "seed"] {
            command = command.mut_arg(id, |arg| {
                let help = arg.get_help().map(|help| format!("{help} [list: one run each]"));
                list(arg).help(help.unwrap_or_default())
            });
        }
        command
            .mut_arg("out", |arg| {
                arg.help("Folder for the model and its reports; with several runs, the parent of their folders")
            })
            .mut_arg("store", |arg| {
                arg.help("Store of photos and results, for a single run; by default the folder `store` under --out")
            })
            .mut_arg("zone_detector", |arg| {
                // --detector measures here.
                arg.long("zone-detector")
            })
            .mut_arg("fresh", |arg| {
                arg.help("Also run combinations that already have a line of this commit on this machine")
            })
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Sweep {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, Error> {
        Self::from_arg_matches_mut(&mut matches.clone())
    }

    fn from_arg_matches_mut(matches: &mut ArgMatches) -> Result<Self, Error> {
        fn all<T: Clone + Send + Sync + 'static>(matches: &ArgMatches, id: &str) -> Vec<T> {
            matches.get_many::<T>(id).into_iter().flatten().cloned().collect()
        }
        let captures: Vec<Named> = all::<PathBuf>(matches, "capture").into_iter().map(Named::from).collect();
        let (steps, budget) = (all(matches, "steps"), all(matches, "budget"));
        let (tolerance_db, backend, seed) =
            (all(matches, "tolerance_db"), all(matches, "backend"), all(matches, "seed"));
        let train = TrainArgs::from_arg_matches_mut(matches)?;
        Ok(Self { captures, steps, budget, tolerance_db, backend, seed, train })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}
