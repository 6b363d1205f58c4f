//! Imports run one way. Between crates: a crate may depend only on crates of lower floors, read from cargo's metadata. Inside a
//! crate: the files' imports form no ring, read from the sources.

mod drawing;
mod modules;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use cargo_metadata::{DependencyKind, Metadata, MetadataCommand, PackageId};

/// Each crate's floor in tenths, lowest first. A normal or build dependency must be strictly lower than its user, a
/// dev-dependency not higher.
const FLOORS: [(&str, u32); 20] = [
    ("scene", 0),
    ("shaders", 0),
    ("blocks", 10),
    ("cluster", 10),
    ("city", 20),
    ("render", 20),
    ("train", 21),
    ("perceive", 22),
    ("store", 30),
    ("proto", 30),
    ("dataset", 31),
    ("model", 31),
    ("eval", 32),
    ("telemetry", 40),
    ("bench", 40),
    ("coordinator", 41),
    ("worker", 41),
    ("serve", 41),
    ("cli", 42),
    ("tests", 50),
];

/// What must not be reachable through normal dependencies, however indirectly.
const ABSENT: [(&str, &[&str]); 11] = [
    ("scene", &["tokio", "object_store", "tonic", "rayon", "wgpu", "image"]),
    ("blocks", &["tokio", "object_store", "tonic", "rayon", "wgpu", "image"]),
    ("cluster", &["tokio", "object_store", "tonic", "rayon", "wgpu", "image"]),
    ("city", &["tokio", "object_store", "tonic"]),
    ("render", &["tokio", "object_store", "tonic"]),
    ("train", &["tokio", "object_store", "tonic"]),
    ("perceive", &["tokio", "object_store", "tonic", "render", "dataset", "image"]),
    ("model", &["dataset", "train", "clap", "indicatif"]),
    ("eval", &["clap", "indicatif"]),
    ("telemetry", &["cluster", "proto", "store", "train"]),
    ("coordinator", &["render", "train", "dataset", "worker", "wgpu"]),
];

/// A dependency of one crate of the workspace on another.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Edge {
    from: String,
    to: String,
    kind: DependencyKind,
}

/// The edges that do not go down, and the crates without a floor, as lines for a person.
fn broken(edges: &[Edge], floors: &BTreeMap<&str, u32>) -> Vec<String> {
    let judge = |edge: &Edge| match (floors.get(&*edge.from), floors.get(&*edge.to)) {
        (Some(from), Some(to)) => {
            let fine = if edge.kind == DependencyKind::Development { to <= from } else { to < from };
            (!fine).then(|| format!("{} -> {} ({}) does not go down", edge.from, edge.to, edge.kind))
        }
        (from, _) => {
            let stranger = if from.is_none() { &edge.from } else { &edge.to };
            Some(format!("{stranger} has no floor yet: choose one in FLOORS"))
        }
    };
    edges.iter().filter_map(judge).collect()
}

fn metadata() -> Metadata {
    let rustc = Command::new("rustc").arg("-vV").output().expect("rustc runs");
    let version = String::from_utf8(rustc.stdout).expect("rustc speaks UTF-8");
    let host = version.lines().find_map(|line| line.strip_prefix("host: ")).expect("rustc knows its host");
    // Only this platform's packages have been fetched for the build.
    MetadataCommand::new()
        .manifest_path(Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml"))
        .other_options(vec!["--filter-platform".into(), host.into()])
        .exec()
        .expect("cargo metadata reads the workspace")
}

fn edges_of(metadata: &Metadata) -> Vec<Edge> {
    let members: BTreeSet<&str> = metadata.workspace_packages().iter().map(|package| package.name.as_str()).collect();
    let mut edges = Vec::new();
    for package in metadata.workspace_packages() {
        let local = package.dependencies.iter().filter(|d| d.path.is_some() && members.contains(d.name.as_str()));
        edges.extend(local.map(|d| Edge { from: package.name.to_string(), to: d.name.clone(), kind: d.kind }));
    }
    edges
}

/// The names of all packages that a member reaches through normal dependencies.
fn reached(metadata: &Metadata, member: &str) -> BTreeSet<String> {
    let resolve = metadata.resolve.as_ref().expect("metadata carries the resolved graph");
    let nodes: BTreeMap<&PackageId, _> = resolve.nodes.iter().map(|node| (&node.id, node)).collect();
    let start = metadata.workspace_packages().into_iter().find(|package| package.name == member);
    let mut open: Vec<&PackageId> = start.map(|package| &package.id).into_iter().collect();
    let mut seen: BTreeSet<&PackageId> = open.iter().copied().collect();
    while let Some(id) = open.pop() {
        for dependency in &nodes[id].deps {
            let normal = dependency.dep_kinds.iter().any(|kind| kind.kind == DependencyKind::Normal);
            if normal && seen.insert(&dependency.pkg) {
                open.push(&dependency.pkg);
            }
        }
    }
    seen.into_iter().map(|id| metadata[id].name.to_string()).collect()
}

#[test]
fn imports_point_down() {
    let edges = edges_of(&metadata());
    assert!(!edges.is_empty(), "a workspace without edges was not read");
    let broken = broken(&edges, &FLOORS.into());
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn an_upward_import_is_detected() {
    let edge = |from: &str, to: &str, kind| Edge { from: from.into(), to: to.into(), kind };
    let floors: BTreeMap<&str, u32> = FLOORS.into();
    for (from, to, kind) in [
        ("scene", "blocks", DependencyKind::Normal),
        ("blocks", "cluster", DependencyKind::Normal),
        ("render", "train", DependencyKind::Build),
        ("coordinator", "worker", DependencyKind::Normal),
        ("scene", "tests", DependencyKind::Development),
        ("scene", "stranger", DependencyKind::Normal),
    ] {
        assert_eq!(broken(&[edge(from, to, kind)], &floors).len(), 1, "{from} -> {to}");
    }
    for (from, to, kind) in [
        ("blocks", "scene", DependencyKind::Normal),
        ("train", "render", DependencyKind::Normal),
        ("coordinator", "worker", DependencyKind::Development),
    ] {
        assert_eq!(broken(&[edge(from, to, kind)], &floors), Vec::<String>::new());
    }
    // And in the real workspace, with one edge more.
    let mut edges = edges_of(&metadata());
    edges.push(edge("scene", "coordinator", DependencyKind::Normal));
    assert_eq!(broken(&edges, &floors).len(), 1);
}

#[test]
fn what_must_be_absent_is_absent() {
    let metadata = metadata();
    assert!(reached(&metadata, "worker").contains("tokio"), "the graph was not read");
    for (member, absent) in ABSENT {
        let reached = reached(&metadata, member);
        assert!(reached.contains(member), "{member} is not in the workspace");
        for name in absent {
            assert!(!reached.contains(*name), "{member} depends on {name}, directly or through others");
        }
    }
}

/// The first ring of each crate is named, with the imports that make it one.
#[test]
fn imports_inside_a_crate_form_no_ring() {
    let metadata = metadata();
    let mut lines = Vec::new();
    let mut files = 0;
    for package in metadata.workspace_packages() {
        let src = package.manifest_path.parent().expect("a manifest lies in a folder").join("src");
        if !src.exists() {
            continue;
        }
        let graph = modules::graph(src.as_std_path());
        files += graph.len();
        for ring in modules::rings(&graph) {
            let name = |module: &modules::Module| if module.is_empty() { "lib".to_owned() } else { module.join("::") };
            lines.push(format!(
                "{}: a ring of imports between {}",
                package.name,
                ring.iter().map(name).collect::<Vec<_>>().join(", ")
            ));
            for from in &ring {
                let to = graph[from].iter().filter(|to| ring.contains(to));
                lines.extend(to.map(|to| format!("    {} imports {}", name(from), name(to))));
            }
        }
    }
    assert!(files > 100, "only {files} files were read");
    assert!(lines.is_empty(), "{}", lines.join("\n"));
}

/// `docs/src/imports.svg` shows the imports between crates as they are. `PLAT_BLESS=1` redraws it.
#[test]
fn the_drawing_of_imports_is_up_to_date() {
    let metadata = metadata();
    let floors: BTreeMap<&str, u32> = FLOORS.into();
    let edges =
        edges_of(&metadata).into_iter().filter(|edge| edge.kind == DependencyKind::Normal && edge.from != "tests");
    let edges: BTreeSet<(String, String)> = edges.map(|edge| (edge.from, edge.to)).collect();
    let members = metadata.workspace_packages().into_iter().map(|package| package.name.to_string());
    let heights = members.filter(|name| name != "tests").map(|name| (name.clone(), floors[name.as_str()])).collect();
    let drawn = drawing::draw(&heights, &edges);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/src/imports.svg");
    if std::env::var_os("PLAT_BLESS").is_some() {
        std::fs::write(&path, &drawn).expect("the drawing is written");
    }
    let kept = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(kept == drawn, "docs/src/imports.svg is out of date: run PLAT_BLESS=1 cargo test -p tests --test floors");
}
