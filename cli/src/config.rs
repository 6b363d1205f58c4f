//! Reads options from the command line and from a TOML file, and writes the configuration file of a run.
//!
//! The keys of the file are the names of the flags. The file is inserted into the command line as flags before the user's own: the last
//! one wins, and one parser checks both.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::error::ErrorKind;
use clap::{ArgAction, CommandFactory, Parser};
use scene::{ArtefactId, BadInput};
use serde::Serialize;

use crate::args::Cli;

/// Largest configuration file, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Why there is no command to run.
#[derive(Debug)]
pub(crate) enum Stop {
    /// Text of help or version, to be printed.
    Shown(String),
    /// Bad usage, in one line.
    Usage(String),
}

/// Parses the command line, including the options of its `--config` file.
pub(crate) fn parse(argv: Vec<OsString>) -> Result<Cli, Stop> {
    let argv = match config_file(&argv) {
        Some(file) => with_file(argv, &file).map_err(|error| Stop::Usage(error.to_string()))?,
        None => argv,
    };
    Cli::try_parse_from(argv).map_err(|error| match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => Stop::Shown(error.to_string()),
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            Stop::Usage("a command is missing; try plat demo, or plat --help for all of them".into())
        }
        _ => Stop::Usage(one_line(&error.to_string())),
    })
}

/// clap's message without usage and tips, on one line.
fn one_line(text: &str) -> String {
    let message = text.split("\n\nUsage:").next().unwrap_or(text).split("\n\nFor more").next().unwrap_or(text);
    let words: Vec<&str> = message.split_whitespace().collect();
    let line = words.join(" ");
    format!("{}; --help lists all options", line.strip_prefix("error: ").unwrap_or(&line))
}

/// The value of the last `--config`.
fn config_file(argv: &[OsString]) -> Option<PathBuf> {
    let mut found = None;
    for (i, argument) in argv.iter().enumerate() {
        match argument.to_str() {
            Some("--") => break,
            Some("--config") => found = argv.get(i + 1).map(PathBuf::from).or(found),
            Some(text) => found = text.strip_prefix("--config=").map(PathBuf::from).or(found),
            None => {}
        }
    }
    found
}

/// Inserts the file's options after the command's name.
fn with_file(mut argv: Vec<OsString>, file: &Path) -> Result<Vec<OsString>, BadInput> {
    let name = file.display().to_string();
    let bad = |problem: String, advice: &str| BadInput::new(name.clone(), problem, advice);
    let unreadable = |problem: String| bad(problem, "give --config a TOML file with a command's options");
    let length = std::fs::metadata(file).map_err(|e| unreadable(format!("cannot be read ({e})")))?.len();
    if length > MAX_FILE_BYTES {
        return Err(unreadable(format!("has {length} bytes, which is too large for a configuration")));
    }
    let text = std::fs::read_to_string(file).map_err(|e| unreadable(format!("cannot be read ({e})")))?;
    let table: toml::Table = text.parse().map_err(|e: toml::de::Error| {
        let line = e.span().map_or(1, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
        bad(format!("line {line} is not TOML ({})", e.message()), "correct it")
    })?;

    // Descends through command and subcommand.
    let mut command = Cli::command();
    let globals: Vec<clap::Arg> = command.get_arguments().cloned().collect();
    let (mut at, mut i) = (None, 1);
    while i < argv.len() {
        if argv[i] == "--config" {
            i += 2;
            continue;
        }
        match argv[i].to_str().and_then(|word| command.find_subcommand(word)) {
            Some(found) => (command, at) = (found.clone(), Some(i + 1)),
            None if at.is_some() => break,
            None => {}
        }
        i += 1;
    }
    let Some(at) = at else { return Ok(argv) };

    let options: Vec<&clap::Arg> = command.get_arguments().chain(&globals).collect();
    let mut flags = Vec::new();
    for (key, value) in &table {
        let option = options.iter().find(|option| option.get_long() == Some(key) && key != "config");
        let option = option.ok_or_else(|| {
            let problem = format!("'{key}' is not an option of plat {}", command.get_name());
            bad(problem, "remove it, or look up its name with --help")
        })?;
        match (option.get_action(), value) {
            (ArgAction::SetTrue, toml::Value::Boolean(on)) => flags.extend(on.then(|| format!("--{key}").into())),
            (ArgAction::Set, toml::Value::String(text)) => flags.push(format!("--{key}={text}").into()),
            (ArgAction::Set, toml::Value::Integer(number)) => flags.push(format!("--{key}={number}").into()),
            (ArgAction::Set, toml::Value::Float(number)) => flags.push(format!("--{key}={number}").into()),
            (ArgAction::Append, toml::Value::Array(values)) if values.iter().all(toml::Value::is_str) => {
                flags.extend(values.iter().filter_map(|text| Some(format!("--{key}={}", text.as_str()?).into())));
            }
            _ => return Err(bad(format!("'{key}' has a value of the wrong type"), "see --help for its values")),
        }
    }
    // Each option is checked alone first, so that an error names the file instead of a flag that the user did not type.
    for flag in &flags {
        let alone = argv[..at].iter().chain([flag]).cloned();
        if let Err(error) = Cli::try_parse_from(alone)
            && matches!(error.kind(), ErrorKind::InvalidValue | ErrorKind::ValueValidation)
        {
            return Err(bad(one_line(&error.to_string()), "correct the file"));
        }
    }
    argv.splice(at..at, flags);
    Ok(argv)
}

/// A resolved configuration as a file that `--config` reads, and its hash.
pub(crate) fn resolved<T: Serialize>(options: &T) -> (String, ArtefactId) {
    let text = toml::to_string(options).expect("options are plain data with keys");
    let id = ArtefactId::of(text.as_bytes());
    (text, id)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::Command;

    fn parse(words: &[&str]) -> Result<Cli, Stop> {
        super::parse(words.iter().map(OsString::from).collect())
    }

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    fn refused(words: &[&str]) -> String {
        match parse(words) {
            Err(Stop::Usage(line)) => line,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn flags_win_over_the_file_and_the_file_over_defaults() {
        let file = file("steps = 7\nseed = 5\nlevels = \"auto\"\nquiet = true\nout = \"there\"\n");
        let path = file.path().to_str().unwrap();
        for words in [
            vec!["plat", "train", "here", "--seed", "6", "--config", path],
            vec!["plat", "--config", path, "train", "--seed=6", "here"],
        ] {
            let cli = parse(&words).unwrap();
            let Command::Train(train) = cli.command else { panic!("not train") };
            assert_eq!((train.plan.steps.0, train.plan.seed, train.plan.test_every), (Some(7), 6, 8));
            assert!(cli.quiet && train.out == Path::new("there") && train.capture == Path::new("here"));
        }
    }

    #[test]
    fn the_configuration_of_a_run_can_be_read_back() {
        let cli = parse(&["plat", "train", "a", "--out", "b", "--budget", "900", "--blocks", "flat"]).unwrap();
        let Command::Train(train) = cli.command else { panic!("not train") };
        let (text, id) = resolved(&train);
        let file = file(&text);
        let again = parse(&["plat", "train", "a", "--out", "b", "--config", file.path().to_str().unwrap()]).unwrap();
        let Command::Train(again) = again.command else { panic!("not train") };
        assert_eq!(resolved(&again), (text, id));
    }

    #[test]
    fn a_list_repeats_an_option() {
        let file = file("fault = [\"fog=0.5\", \"night\"]\n");
        let path = file.path().to_str().unwrap();
        let cli = parse(&["plat", "synth", "--out", "a", "--fault", "rain", "--config", path]).unwrap();
        let Command::Synth(synth) = cli.command else { panic!("not synth") };
        let faults: Vec<_> = synth.fault.iter().map(|f| (f.kind.name(), f.strength)).collect();
        assert_eq!(faults, [("fog", 0.5), ("night", 1.0), ("rain", 1.0)]);
    }

    #[test]
    fn bad_files_are_named_in_one_line() {
        for (text, wanted) in [
            ("stepps = 3", "stepps"),
            ("steps = ", "line 1"),
            ("seed = 1\nsteps = \"many\"", "many"),
            ("steps = true", "steps"),
            ("steps = [1, 2]", "steps"),
            ("steps = [\"1\"]", "steps"),
            ("config = \"other.toml\"", "config"),
        ] {
            let file = file(text);
            let path = file.path().to_str().unwrap();
            let line = refused(&["plat", "train", "a", "--out", "b", "--config", path]);
            assert!(line.contains(path) && line.contains(wanted) && !line.contains('\n'), "{text}: {line}");
        }
        assert!(refused(&["plat", "train", "a", "--out", "b", "--config", "/no/such"]).contains("/no/such"));
    }

    #[test]
    fn bad_usage_is_one_line() {
        for (words, wanted) in [
            (&["plat", "train", "a", "--out", "b", "--speed", "9"][..], "--speed"),
            (&["plat", "train", "a"][..], "--out"),
            (&["plat", "train", "a", "--out", "b", "--levels", "deep"][..], "levels"),
            (&["plat", "render", "m", "--cameras", "c", "--out", "o", "--size", "0x3"][..], "640x480"),
            (&["plat", "fly"][..], "fly"),
            (&["plat"][..], "plat demo"),
        ] {
            let line = refused(words);
            assert!(line.contains(wanted) && !line.contains('\n'), "{line}");
        }
        assert!(matches!(parse(&["plat", "--help"]), Err(Stop::Shown(_))));
    }
}
