//! `plat bench stability`: trains on captures with known failures, without and with plat's counter-measure, and measures both.
//!
//! Seeds come one after the other, and within a seed a case's two models are trained in turn, so that other load on the machine
//! affects both alike. Runs whose line exists are skipped, so an interrupted matrix can be resumed.

use std::fs;
use std::path::{Path, PathBuf};

use ::bench::parts::Stability;
use ::bench::{PartLine, append_part, read_parts};
use clap::Parser;
use eval::{PhotoOptions, side_by_side, write_png};
use scene::BadInput;
use serde::Serialize;

use crate::args::{Cli, Command, EvalArgs, StabilityArgs, SynthArgs, TrainArgs};
use crate::captures;
use crate::commands::eval::measure;
use crate::commands::prune_orders::judged;
use crate::commands::{synth, train};
use crate::eval_report::Evaluated;
use crate::failure::{Failure, cannot, make_folder};
use crate::output::Output;
use crate::run_record::{commit, invocation};
use crate::stability_cases::{Case, Counter, DEPTHS, MeasuredOn};
use crate::stability_table::{GENERATED, Row, row, table};

/// The file of lines.
const LINES: &str = "stability.jsonl";
/// Rows of a case's pictures.
const ROWS: usize = 4;
/// What a pose that is not a number looks like in a capture's transforms.json, in place of its first number.
const NOT_A_NUMBER: &str = "1e999";

#[derive(Serialize)]
struct Matrix<'a> {
    command: &'static str,
    rows: &'a [Row],
    lines: &'a [Stability],
}

/// A case on a capture.
struct Stage<'a> {
    case: &'a Case,
    capture_name: String,
    trained_on: PathBuf,
    measured_on: PathBuf,
    /// Options of `plat synth` and `plat train` without those of the counter-measure.
    synth: String,
    train: &'a str,
    /// Whether the capture has triangulated points. Without them, and without lidar, there are no target depths to weigh.
    is_triangulated: bool,
}

pub(crate) fn run(args: &StabilityArgs, output: &Output) -> Result<(), Failure> {
    make_folder(&args.results)?;
    make_folder(&args.out)?;
    let file = args.results.join(LINES);
    let existing = if file.exists() { read_parts(&file)? } else { Vec::new() };
    let existing: Vec<Stability> = existing
        .into_iter()
        .filter_map(|line| if let PartLine::Stability(line) = line { Some(line) } else { None })
        .collect();
    for of in &args.captures {
        let known = of.name.as_ref().is_some_and(|name| args.cases.iter().any(|case| case.name == *name));
        if !known {
            let given = of.name.clone().unwrap_or_else(|| of.path.display().to_string());
            return Err(BadInput::new(given, "is no case that is run", "give captures as CASE=PATH").into());
        }
    }
    let mut lines: Vec<Stability> = Vec::new();
    let mut rows = Vec::new();
    for stage in stages(args, output)? {
        let (case, of_case) = (stage.case, lines.len());
        for &seed in &args.seeds {
            for on in [false, true] {
                if on && case.counter.name().is_none() || !on && case.counter == Counter::Refusal {
                    continue;
                }
                let line = Stability { seed, ..blank_line(&stage, on) };
                let line = match existing.iter().rfind(|of| is_same_run(of, &line)) {
                    Some(known) => known.clone(),
                    None => {
                        let line = measured(&stage, line, args, output)?;
                        append_part(&file, &PartLine::Stability(line.clone()))?;
                        line
                    }
                };
                output.note(described(&line));
                lines.push(line);
            }
            draw(&stage, seed, args, output)?;
        }
        rows.push(row(case, &lines[of_case..]));
    }
    let table = table(&rows);
    if let Some(document) = &args.document {
        let text = fs::read_to_string(document).map_err(cannot("read", document))?;
        let text = ::bench::replace_table(&text, &table).ok_or_else(|| {
            let problem = "has no place for the table";
            BadInput::new(document.display().to_string(), problem, "add <!-- bench:begin --> and <!-- bench:end -->")
        })?;
        store::file::save(document, text.as_bytes())?;
    }
    let matrix = Matrix { command: "bench stability", rows: &rows, lines: &lines };
    output.result(&matrix, &format!("{table}\nlines in {}", file.display()))
}

/// The cases in order, each on its generated capture and on those that are given for it.
fn stages<'a>(args: &'a StabilityArgs, output: &Output) -> Result<Vec<Stage<'a>>, Failure> {
    let mut stages = Vec::new();
    for case in &args.cases {
        stages.push(generated(case, args, output)?);
        for of in args.captures.iter().filter(|of| of.name.as_deref() == Some(case.name)) {
            if !case.takes_captures() {
                let problem = "needs a generated capture: it is measured without its fault";
                return Err(BadInput::new(case.name, problem, "leave its capture out").into());
            }
            stages.push(Stage {
                case,
                capture_name: captures::name_of(&of.path),
                trained_on: of.path.clone(),
                measured_on: of.path.clone(),
                synth: String::new(),
                train: &args.train_given,
                is_triangulated: !captures::open(&of.path, output)?.capture.points.seen_by.is_empty(),
            });
        }
    }
    Ok(stages)
}

/// Makes the captures of a case, unless they are there.
fn generated<'a>(case: &'a Case, args: &'a StabilityArgs, output: &Output) -> Result<Stage<'a>, Failure> {
    let folder = |kind: &str| args.out.join("captures").join(format!("{}-{kind}", case.name));
    let make = |to: &Path, options: &str| -> Result<(), Failure> {
        if !is_complete(to) {
            synth::write(&synth_args(to, options)?, to, output)?;
        }
        Ok(())
    };
    let synth = format!("{} {}", args.synth, case.synth);
    let own = folder("own");
    make(&own, &synth)?;
    let mut measured_on = own.clone();
    if case.photos == MeasuredOn::Clean {
        measured_on = folder("clean");
        make(&measured_on, &without_faults(&synth))?;
    }
    if case.counter == Counter::Refusal {
        spoil(&own)?;
    }
    let capture_name = GENERATED.to_owned();
    Ok(Stage { case, capture_name, trained_on: own, measured_on, synth, train: &args.train, is_triangulated: true })
}

/// Whether all of a generated capture is there.
fn is_complete(capture: &Path) -> bool {
    let manifest = fs::read(capture.join("manifest.json")).ok();
    let manifest = manifest.and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok());
    manifest.is_some_and(|manifest| manifest["complete"] == true)
}

/// The options without `--fault` and its value.
fn without_faults(options: &str) -> String {
    let mut words = options.split_whitespace();
    let mut kept = Vec::new();
    while let Some(word) = words.next() {
        if word == "--fault" {
            words.next();
        } else {
            kept.push(word);
        }
    }
    kept.join(" ")
}

/// Makes the first number of the first pose one that no number is. Of the same capture's files only transforms.json stays.
fn spoil(capture: &Path) -> Result<(), Failure> {
    let file = capture.join("transforms.json");
    let text = fs::read_to_string(&file).map_err(cannot("read", &file))?;
    if !text.contains(NOT_A_NUMBER) {
        let at = text.find("transform_matrix").and_then(|at| Some(at + text[at..].find(|c: char| c.is_ascii_digit())?));
        let at = at.ok_or_else(|| Failure::Work(format!("{} has no pose", file.display())))?;
        let end = text[at..].find([',', ']']).map_or(text.len(), |end| at + end);
        store::file::save(&file, format!("{}{NOT_A_NUMBER}{}", &text[..at], &text[end..]).as_bytes())?;
    }
    let colmap = capture.join("sparse");
    if colmap.exists() { fs::remove_dir_all(&colmap).map_err(cannot("removed", &colmap)) } else { Ok(()) }
}

fn model_folder(stage: &Stage, on: bool, seed: u64, args: &StabilityArgs) -> PathBuf {
    let (case, kind) = (stage.case.name, if on { "on" } else { "off" });
    args.out.join("models").join(format!("{case}-{}-{kind}-{seed}", stage.capture_name))
}

/// Trains and measures a model.
fn measured(stage: &Stage, line: Stability, args: &StabilityArgs, output: &Output) -> Result<Stability, Failure> {
    let out = model_folder(stage, line.on, line.seed, args);
    let capture = &stage.trained_on;
    let may_refuse = match stage.case.counter {
        Counter::Refusal => true,
        Counter::Enables(_) => !line.on,
        Counter::Missing | Counter::Options(_) => false,
    };
    let trained = match train::train(&train_args(capture, &out, line.seed, &line.options[1])?, output) {
        Err(Failure::Input(refused)) if may_refuse => {
            // The line is kept, and the folder is this machine's.
            let folder = capture.canonicalize().unwrap_or_else(|_| capture.clone());
            let refused = refused.replace(&format!("{}/", folder.display()), "");
            return Ok(Stability { refused: Some(refused), ..line });
        }
        other => other?,
    };
    let mut words = vec![out.display().to_string(), stage.measured_on.display().to_string()];
    words.extend(stage.case.eval.split_whitespace().map(str::to_owned));
    for detector in &args.detector {
        words.extend(["--detector".to_owned(), detector.display().to_string()]);
    }
    let found = measure(&eval_args(&words)?, output)?;
    let record = trained.report.record;
    let line = with_figures(line, &found);
    let store = out.join("store");
    if store.exists() {
        // Photos and checkpoints would fill the disk once per run.
        fs::remove_dir_all(&store).map_err(cannot("removed", &store))?;
    }
    Ok(Stability { splats: record.splats, cpu_seconds: record.cpu_seconds.unwrap_or_default(), ..line })
}

fn with_figures(line: Stability, found: &Evaluated) -> Stability {
    Stability {
        psnr: found.record.psnr,
        street_psnr: found.by_kind.street.and_then(|of| of.psnr),
        fitted_psnr: found.psnr_fitted,
        ssim: found.record.ssim,
        depth_absrel: found.depth.as_ref().and_then(|of| of.groups.held_out.all.absrel),
        seam_db: found.seams.as_ref().and_then(|of| of.figures.gap_db).map(|gap| -gap),
        judged: found.detections.iter().map(|of| judged(of.detector.clone(), &of.groups.held_out.all)).collect(),
        ..line
    }
}

/// Draws photo, off, on for the models of a seed that are there.
fn draw(stage: &Stage, seed: u64, args: &StabilityArgs, output: &Output) -> Result<(), Failure> {
    let Some(pictures) = &args.pictures else { return Ok(()) };
    let path = pictures.join(format!("{}-{}.png", stage.case.name, stage.capture_name));
    if path.exists() {
        return Ok(());
    }
    let folders = [false, true].map(|on| model_folder(stage, on, seed, args));
    let models = folders.iter().filter(|of| of.exists()).map(|of| model::read(of)).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = models.first() else { return Ok(()) };
    let source = captures::open(&stage.measured_on, output)?;
    let photos = captures::photos_of(first, &source, &PhotoOptions::default(), output)?;
    make_folder(pictures)?;
    Ok(write_png(&path, &side_by_side(&photos, &models.iter().collect::<Vec<_>>(), ROWS)?)?)
}

fn blank_line(stage: &Stage, on: bool) -> Stability {
    let own = stage.case.train[usize::from(on)];
    let own = if on || stage.is_triangulated { own } else { own.trim_end_matches(DEPTHS) };
    let train = format!("{} {own}", stage.train);
    Stability {
        commit: commit().to_owned(),
        machine: ::bench::machine(),
        case: stage.case.name.to_owned(),
        capture: stage.capture_name.clone(),
        on,
        counter: stage.case.counter.name().map(str::to_owned),
        seed: 0,
        options: [stage.synth.trim(), train.trim()].map(str::to_owned),
        refused: None,
        psnr: None,
        street_psnr: None,
        fitted_psnr: None,
        ssim: None,
        depth_absrel: None,
        seam_db: None,
        judged: Vec::new(),
        splats: 0,
        cpu_seconds: 0.0,
        command: invocation(),
    }
}

fn is_same_run(known: &Stability, line: &Stability) -> bool {
    let key = |of: &Stability| (of.commit.clone(), of.machine.clone(), of.case.clone(), of.capture.clone());
    key(known) == key(line) && known.on == line.on && known.seed == line.seed && known.options == line.options
}

/// Parses the options of a command as a person would type them.
fn parsed(command: &str, words: &[String]) -> Result<Command, Failure> {
    let all = ["plat".to_owned(), command.to_owned()].into_iter().chain(words.iter().cloned());
    let cli = Cli::try_parse_from(all).map_err(|error| Failure::Input(error.to_string()))?;
    Ok(cli.command)
}

fn words(options: &str) -> impl Iterator<Item = String> + '_ {
    options.split_whitespace().map(str::to_owned)
}

fn synth_args(out: &Path, options: &str) -> Result<SynthArgs, Failure> {
    // The last of two values of an option counts, as a case may change what all cases have.
    let mut all = vec!["--out".to_owned(), out.display().to_string()];
    all.extend(last_of_each(options));
    match parsed("synth", &all)? {
        Command::Synth(args) => Ok(args),
        _ => unreachable!("the command is synth"),
    }
}

fn train_args(capture: &Path, out: &Path, seed: u64, options: &str) -> Result<TrainArgs, Failure> {
    let mut all = vec![capture.display().to_string(), "--out".to_owned(), out.display().to_string()];
    all.extend(["--seed".to_owned(), seed.to_string(), "--fresh".to_owned()]);
    all.extend(last_of_each(options));
    match parsed("train", &all)? {
        Command::Train(args) => Ok(args),
        _ => unreachable!("the command is train"),
    }
}

fn eval_args(words: &[String]) -> Result<EvalArgs, Failure> {
    match parsed("eval", words)? {
        Command::Eval(args) => Ok(args),
        _ => unreachable!("the command is eval"),
    }
}

/// The words of options without those that a later one of the same name replaces. Faults may be given several times.
fn last_of_each(options: &str) -> Vec<String> {
    let mut groups: Vec<Vec<String>> = Vec::new();
    for word in words(options) {
        match groups.last_mut() {
            Some(group) if !word.starts_with("--") => group.push(word),
            _ => groups.push(vec![word]),
        }
    }
    let is_last = |i: usize| groups[i][0] == "--fault" || groups[i + 1..].iter().all(|later| later[0] != groups[i][0]);
    (0..groups.len()).filter(|&i| is_last(i)).flat_map(|i| groups[i].clone()).collect()
}

/// A line as text.
fn described(line: &Stability) -> String {
    let what = format!("{}, {}, seed {}, {}", line.case, line.capture, line.seed, if line.on { "on" } else { "off" });
    match (&line.refused, line.psnr) {
        (Some(refused), _) => format!("{what}: refused: {refused}"),
        (None, Some(psnr)) => format!("{what}: {psnr:.2} dB, {:.0} CPU s, {} splats", line.cpu_seconds, line.splats),
        (None, None) => what,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stability_cases::CASES;

    #[test]
    fn every_case_is_made_of_options_that_the_commands_have() {
        let at = Path::new("folder");
        for case in &CASES {
            let synth = format!("--views 9 --traffic light {}", case.synth);
            synth_args(at, &synth).unwrap();
            synth_args(at, &without_faults(&synth)).unwrap();
            for options in case.train {
                train_args(at, at, 1, &format!("--levels 1 {options}")).unwrap();
            }
            let words: Vec<String> =
                ["model", "capture"].into_iter().chain(case.eval.split_whitespace()).map(str::to_owned).collect();
            eval_args(&words).unwrap();
        }
    }

    #[test]
    fn later_options_replace_earlier_ones_and_faults_add_up() {
        let words = last_of_each("--views 9 --truth --fault fog --views 5 --fault rain=0.5");
        assert_eq!(words, ["--truth", "--fault", "fog", "--views", "5", "--fault", "rain=0.5"]);
        assert_eq!(without_faults("--views 9 --fault fog --truth --fault rain=1"), "--views 9 --truth");
    }
}
