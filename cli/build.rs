//! Tells the program which commit it was built from.

use std::path::Path;
use std::process::Command;

fn main() {
    // Result lines are what the program writes, not what it is made of.
    let changed = git(&["status", "--porcelain", "--untracked-files=no", "--", "..", ":(exclude,top)bench/results"]);
    if let Some(commit) = git(&["rev-parse", "--short=12", "HEAD"]) {
        let dirty = if changed.is_none_or(|files| files.is_empty()) { "" } else { "-dirty" };
        println!("cargo::rustc-env=PLAT_COMMIT={commit}{dirty}");
    }
    println!("cargo::rerun-if-changed=build.rs");
    // The log of HEAD grows with every commit; a checkout may come without one, and a worktree has its own elsewhere. A
    // missing file would make every build a new one.
    let mut signs = ["logs/HEAD", "index"].into_iter().filter_map(|file| git(&["rev-parse", "--git-path", file]));
    if let Some(sign) = signs.find(|sign| Path::new(sign).exists()) {
        println!("cargo::rerun-if-changed={sign}");
    }
}

/// What git says, without its line end; `None` where there is no git or no repository.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
