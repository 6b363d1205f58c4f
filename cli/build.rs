//! Tells the program which commit it was built from.

use std::path::Path;
use std::process::Command;

fn main() {
    let described =
        Command::new("git").args(["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]).output();
    if let Ok(described) = described
        && described.status.success()
    {
        println!("cargo::rustc-env=PLAT_COMMIT={}", String::from_utf8_lossy(&described.stdout).trim());
    }
    println!("cargo::rerun-if-changed=build.rs");
    // The log of HEAD grows with every commit; a missing file would make every build a new one.
    let log = "../.git/logs/HEAD";
    if Path::new(log).exists() {
        println!("cargo::rerun-if-changed={log}");
    }
}
