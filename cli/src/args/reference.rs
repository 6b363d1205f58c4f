//! Renders the command line as Markdown and compares it with `docs/src/command-line.md`. `PLAT_BLESS=1` rewrites the file.

use std::fmt::Write;
use std::path::Path;

use clap::{Arg, Command, CommandFactory};

use super::Cli;

const HEAD: &str = "# Command line\n\n\
    This chapter is generated from the program: `PLAT_BLESS=1 cargo test -p cli reference` rewrites it.\n\n\
    Every option can also come from a TOML file (`--config FILE`), under its name without the dashes. Flags override the file.\n";

/// The reference of a command and its subcommands, depth first.
fn reference(command: &Command, text: &mut String) {
    let name = command.get_bin_name().unwrap_or_else(|| command.get_name());
    let _ = write!(text, "\n## {name}\n");
    if let Some(about) = command.get_long_about().or(command.get_about()) {
        let _ = write!(text, "\n{}\n", escaped(&about.to_string()));
    }
    let usage = command.clone().render_usage().to_string();
    let usage = usage.trim_start_matches("Usage:").trim();
    let _ = write!(text, "\n```text\n{usage}\n```\n");
    let is_listed = |arg: &&Arg| !(arg.is_hide_set() || matches!(arg.get_id().as_str(), "help" | "version"));
    // Global options are listed once, at the root.
    let is_own = |arg: &&Arg| !arg.is_global_set() || command.get_name() == "plat";
    let mut items = command.get_arguments().filter(is_listed).filter(is_own).map(item).peekable();
    if items.peek().is_some() {
        text.push('\n');
        text.extend(items);
    }
    if let Some(more) = command.get_after_long_help() {
        let _ = write!(text, "\n```text\n{}\n```\n", more.to_string().trim_end());
    }
    let subcommands: Vec<&Command> = command.get_subcommands().filter(|sub| sub.get_name() != "help").collect();
    if !subcommands.is_empty() {
        text.push('\n');
        for sub in &subcommands {
            let name = sub.get_bin_name().unwrap_or_else(|| sub.get_name());
            let about = sub.get_about().map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(text, "- [{name}](#{}): {}", name.replace(' ', "-"), escaped(&about));
        }
    }
    subcommands.into_iter().for_each(|sub| reference(sub, text));
}

/// An argument as an item of a list.
fn item(arg: &Arg) -> String {
    let has_value = arg.get_action().takes_values();
    let values: Vec<&str> = arg.get_value_names().unwrap_or_default().iter().map(|name| name.as_str()).collect();
    let values: String = values.iter().map(|name| format!(" <{name}>")).collect();
    let shown = match arg.get_long() {
        Some(long) if has_value => format!("--{long}{values}"),
        Some(long) => format!("--{long}"),
        None => values.trim_start().to_owned(),
    };
    let help = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    let help = escaped(help.trim_end()).replace('\n', "\n  ").replace("\n  \n", "\n\n");
    let mut text = format!("- `{shown}`: {help}");
    let defaults: Vec<_> = arg.get_default_values().iter().map(|value| value.to_string_lossy()).collect();
    if has_value && !defaults.is_empty() {
        let _ = write!(text, " (default: `{}`)", defaults.join(","));
    }
    text.push('\n');
    if has_value {
        for value in arg.get_possible_values().iter().filter(|value| !value.is_hide_set()) {
            let help = value.get_help().map(|help| format!(": {}", escaped(&help.to_string()))).unwrap_or_default();
            let _ = writeln!(text, "  - `{}`{help}", value.get_name());
        }
    }
    text
}

/// Text in which `<` starts no HTML element. Code spans stay as they are.
fn escaped(text: &str) -> String {
    let parts = text.split('`').enumerate();
    let parts: Vec<String> =
        parts.map(|(i, part)| if i % 2 == 0 { part.replace('<', "\\<") } else { part.to_owned() }).collect();
    parts.join("`")
}

#[test]
fn the_chapter_is_up_to_date() {
    let mut root = Cli::command();
    root.build();
    let mut text = HEAD.to_owned();
    reference(&root, &mut text);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/src/command-line.md");
    if std::env::var_os("PLAT_BLESS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(kept == text, "docs/src/command-line.md is out of date: run PLAT_BLESS=1 cargo test -p cli reference");
}
