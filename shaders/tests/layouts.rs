//! Every stage is valid WGSL, and its structures lie in memory as their Rust twins do.

use std::collections::BTreeMap;
use std::mem::offset_of;

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{Module, TypeInner};
use shaders::train::{self, Books, Rates, Window, Windows};
use shaders::{HALF, Pass, Planes, RASTERIZE_BACKWARD_ATOMICS, STAGES, SUBGROUPS, Set, Stage, Status, View, Views};

/// Name and byte offset of each member, and the size of the whole.
type Layout = (Vec<(String, usize)>, usize);

macro_rules! layout {
    ($type:ident: $($member:ident),*) => {
        (stringify!($type), (vec![$((stringify!($member).to_string(), offset_of!($type, $member))),*], size_of::<$type>()))
    };
}

fn twins() -> BTreeMap<&'static str, Layout> {
    [
        layout!(View: rows, centre, focal, principal, cone_min, cone_max, pixels, tiles, first_tile, first_pixel, padding),
        layout!(Views: background, count, tiles, pixels, own, total, pair_capacity, antialiased, extras, each),
        layout!(Set: first, count, stride, sh_degree),
        layout!(Planes: transmittance, depth, padding),
        layout!(Pass: slot, shift, padding),
        layout!(Status: overflow, fault, pairs, most_pairs, visible, seen, splat_slots, visible_slots, visible_digits,
            pair_digits),
        layout!(Books: done, adam_steps, skipped, count, sum, loss, good, padding, scales),
        layout!(Window: width, height, tiles_x, tiles_y, first_tile, first_pixel, first_byte, masked),
        layout!(Windows: count, tiles, lambda, by_share, each),
        layout!(Rates: mean, log_scale, quat, opacity, sh_dc, sh_rest, beta2, opacity_pull, needle_pull, log_scale_min,
            log_scale_max, columns, stride, views, padding),
    ]
    .into()
}

/// The structures of a module by name.
fn structures(module: &Module) -> BTreeMap<String, Layout> {
    (module.types.iter())
        .filter_map(|(_, kind)| match &kind.inner {
            TypeInner::Struct { members, span } => {
                let members = members.iter().map(|m| (m.name.clone().unwrap_or_default(), m.offset as usize)).collect();
                Some((kind.name.clone()?, (members, *span as usize)))
            }
            _ => None,
        })
        .collect()
}

/// What the stages of [`HALF`] need.
const FOR_HALF: Capabilities = Capabilities::SUBGROUP.union(Capabilities::SHADER_FLOAT16_IN_FLOAT32);

/// Every stage, and what an adapter must have for it.
fn stages() -> impl Iterator<Item = (&'static Stage, Capabilities)> {
    let plain = STAGES.iter().chain(train::STAGES).chain([&RASTERIZE_BACKWARD_ATOMICS]);
    let faster = SUBGROUPS.iter().map(|s| (s, Capabilities::SUBGROUP)).chain(HALF.iter().map(|s| (s, FOR_HALF)));
    plain.map(|s| (s, Capabilities::empty())).chain(faster)
}

fn parse(name: &str, source: &str, needs: Capabilities) -> Result<Module, String> {
    let module = naga::front::wgsl::parse_str(source).map_err(|e| format!("{name}: {}", e.emit_to_string(source)))?;
    let mut validator = Validator::new(ValidationFlags::all(), needs);
    validator.validate(&module).map_err(|e| format!("{name}: {}", e.emit_to_string(source)))?;
    Ok(module)
}

#[test]
fn stages_are_valid_and_agree_with_their_twins() {
    let twins = twins();
    let mut compared: BTreeMap<&str, usize> = BTreeMap::new();
    for (stage, needs) in stages() {
        let module = parse(stage.name, &stage.source(), needs).unwrap_or_else(|e| panic!("{e}"));
        let entries: Vec<&str> = module.entry_points.iter().map(|entry| entry.name.as_str()).collect();
        assert_eq!(entries, stage.entries, "entry points of {}", stage.name);
        for entry in &module.entry_points {
            let threads: u32 = entry.workgroup_size.iter().product();
            assert!(threads == shaders::GROUP || threads == 1, "{} has {threads} threads", entry.name);
        }
        for (name, layout) in structures(&module) {
            if let Some((&twin, expected)) = twins.get_key_value(name.as_str()) {
                assert_eq!(&layout, expected, "{name} in {}", stage.name);
                *compared.entry(twin).or_default() += 1;
            }
        }
    }
    for name in twins.keys() {
        assert!(compared.contains_key(name), "no stage has a structure {name}");
    }
}

#[test]
fn subgroups_take_the_place_of_portable_stages() {
    for stage in SUBGROUPS.iter().chain(HALF) {
        let mut portable = stages().filter(|(other, needs)| other.name == stage.name && needs.is_empty());
        let (portable, _) = portable.next().unwrap_or_else(|| panic!("{} is for subgroups only", stage.name));
        assert_eq!(portable.entries, stage.entries);
        let bindings = |stage: &Stage, needs| -> Vec<String> {
            let module = parse(stage.name, &stage.source(), needs).unwrap_or_else(|e| panic!("{e}"));
            let bindings =
                module.global_variables.iter().filter_map(|(_, variable)| variable.binding.map(|b| (b, variable)));
            let mut all: Vec<String> = bindings.map(|(at, variable)| format!("{at:?} {:?}", variable.space)).collect();
            all.sort();
            all
        };
        assert_eq!(bindings(portable, Capabilities::empty()), bindings(stage, FOR_HALF), "{}", stage.name);
        assert!(parse(stage.name, &stage.source(), Capabilities::empty()).is_err(), "{} uses none", stage.name);
    }
}

#[test]
fn a_wrong_layout_and_a_wrong_stage_are_seen() {
    let moved = "struct Set { count: u32, first: u32, stride: u32, sh_degree: u32, }
        @group(0) @binding(0) var<uniform> s: Set;
        @compute @workgroup_size(1) fn main() { let x = s.count; }";
    let module = parse("moved", moved, Capabilities::empty()).unwrap_or_else(|e| panic!("{e}"));
    assert_ne!(structures(&module)["Set"], twins()["Set"]);
    assert!(parse("untyped", "fn f() -> u32 { return 1.5; }", Capabilities::empty()).is_err());
}

/// `const NAME: type = value;` lines of all stages agree with the Rust constants of the same name.
#[test]
fn constants_agree() {
    let expected: BTreeMap<&str, u32> = [
        ("GROUP", shaders::GROUP),
        ("TILE", shaders::TILE),
        ("MOMENTS", shaders::MOMENTS),
        ("MOST_VIEWS", shaders::MOST_VIEWS as u32),
        ("SCAN_BLOCK", shaders::SCAN_BLOCK),
        ("RADIX_BLOCK", shaders::RADIX_BLOCK),
        ("DIGITS", shaders::DIGITS),
        ("REDUCE_SPLATS", shaders::REDUCE_SPLATS),
    ]
    .into();
    let mut found = BTreeMap::new();
    for (stage, _) in stages() {
        for line in stage.source().lines() {
            let Some((name, value)) = line.strip_prefix("const ").and_then(|line| line.split_once(": u32 = ")) else {
                continue;
            };
            let value: u32 = value.split(['u', ';']).next().unwrap_or_default().parse().unwrap_or_default();
            // `scan` and `radix` call theirs BLOCK.
            let name = match (stage.name, name) {
                ("scan", "BLOCK") => "SCAN_BLOCK",
                ("radix", "BLOCK") => "RADIX_BLOCK",
                _ => name,
            };
            if let Some((&name, expected)) = expected.get_key_value(name) {
                assert_eq!(value, *expected, "{name} in {}", stage.name);
                found.insert(name, value);
            }
        }
    }
    assert_eq!(found, expected, "constants that no stage has");
}
