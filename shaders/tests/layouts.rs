//! Every stage is valid WGSL, and its structs have the memory layout of their Rust counterparts.

use std::collections::BTreeMap;
use std::mem::offset_of;

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{Module, TypeInner};
use shaders::train::{
    self, AdamConstants, ExposureConstants, GivenPose, OptimiserState, Photo, Photos, PoseConstants,
    RearrangeConstants, Sensor, SensorCamera, SensorConstants,
};
use shaders::{
    HALF, PassConstants, RASTERIZE_BACKWARD_ATOMICS, STAGES, SUBGROUPS, SplatSet, Stage, Status, UpstreamPlanes, View,
    Views,
};

/// Name and byte offset of each member, and the size of the whole.
type Layout = (Vec<(String, usize)>, usize);

macro_rules! layout {
    ($type:ident: $($member:ident),*) => {
        (stringify!($type), (vec![$((stringify!($member).to_string(), offset_of!($type, $member))),*], size_of::<$type>()))
    };
}

fn rust_layouts() -> BTreeMap<&'static str, Layout> {
    [
        layout!(View: rows, centre, focal, principal, cone_min, cone_max, pixels, tiles, first_tile, first_pixel, displacement, padding),
        layout!(Views: background, count, tiles, pixels, trainable_entries, entries, pair_capacity,
            antialiased, extras, view),
        layout!(SplatSet: first, count, stride, sh_degree),
        layout!(UpstreamPlanes: transmittance, depth, padding),
        layout!(PassConstants: len_word, shift, padding),
        layout!(Status: overflow, fault, pairs, max_pairs, visible, visible_trainable, entry_scan_len, visible_scan_len, visible_histogram_len,
            pair_histogram_len),
        layout!(OptimiserState: steps_done, adam_steps, steps_skipped, epoch_views, epoch_l1, loss, is_step_valid, padding,
            gradient_scales, depth_scales),
        layout!(Photo: width, height, tiles_x, tiles_y, first_tile, first_pixel, first_byte, masked,
            first_weight, first_depth, exposure, first_slope),
        layout!(Photos: count, tiles, lambda, share_weighted, extras, depth_weight, picture_loss, padding, photo),
        layout!(RearrangeConstants: rows, columns, stride, padding),
        layout!(ExposureConstants: rows, rate, padding),
        layout!(GivenPose: rows, translation_rate, padding),
        layout!(PoseConstants: rate, decay, spread, cameras, views, is_anchored, padding, row),
        layout!(Sensor: values, first, second, rates, share, steps, padding),
        layout!(SensorCamera: shift_per_second, sensor, turn_per_second, padding),
        layout!(SensorConstants: rate, decay, cameras, views, row),
        layout!(AdamConstants: mean, log_scale, quat, opacity, sh_dc, sh_rest, beta2, opacity_reg, needle_reg, log_scale_min,
            log_scale_max, columns, stride, views, padding),
    ]
    .into()
}

/// The structs of a module by name.
fn struct_layouts(module: &Module) -> BTreeMap<String, Layout> {
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

/// Naga capabilities of the stages of [`HALF`].
const HALF_CAPABILITIES: Capabilities = Capabilities::SUBGROUP.union(Capabilities::SHADER_FLOAT16_IN_FLOAT32);

/// Every stage with the naga capabilities that it requires.
fn stages() -> impl Iterator<Item = (&'static Stage, Capabilities)> {
    let portable = STAGES.iter().chain(train::STAGES).chain([&RASTERIZE_BACKWARD_ATOMICS]);
    let optional =
        SUBGROUPS.iter().map(|s| (s, Capabilities::SUBGROUP)).chain(HALF.iter().map(|s| (s, HALF_CAPABILITIES)));
    portable.map(|s| (s, Capabilities::empty())).chain(optional)
}

fn parse(name: &str, source: &str, capabilities: Capabilities) -> Result<Module, String> {
    let module = naga::front::wgsl::parse_str(source).map_err(|e| format!("{name}: {}", e.emit_to_string(source)))?;
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    validator.validate(&module).map_err(|e| format!("{name}: {}", e.emit_to_string(source)))?;
    Ok(module)
}

#[test]
fn stages_are_valid_and_layouts_match_rust() {
    let expected_layouts = rust_layouts();
    let mut compared: BTreeMap<&str, usize> = BTreeMap::new();
    for (stage, capabilities) in stages() {
        let module = parse(stage.name, &stage.source(), capabilities).unwrap_or_else(|e| panic!("{e}"));
        let entries: Vec<&str> = module.entry_points.iter().map(|entry| entry.name.as_str()).collect();
        assert_eq!(entries, stage.entries, "entry points of {}", stage.name);
        for entry in &module.entry_points {
            let threads: u32 = entry.workgroup_size.iter().product();
            assert!(threads == shaders::WORKGROUP_SIZE || threads == 1, "{} has {threads} threads", entry.name);
        }
        for (name, layout) in struct_layouts(&module) {
            if let Some((&rust_name, expected)) = expected_layouts.get_key_value(name.as_str()) {
                assert_eq!(&layout, expected, "{name} in {}", stage.name);
                *compared.entry(rust_name).or_default() += 1;
            }
        }
    }
    for name in expected_layouts.keys() {
        assert!(compared.contains_key(name), "no stage has a struct {name}");
    }
}

#[test]
fn subgroup_stages_have_the_bindings_of_the_portable_ones() {
    for stage in SUBGROUPS.iter().chain(HALF) {
        let mut portable = stages().filter(|(other, capabilities)| other.name == stage.name && capabilities.is_empty());
        let (portable, _) = portable.next().unwrap_or_else(|| panic!("{} has no portable version", stage.name));
        assert_eq!(portable.entries, stage.entries);
        let bindings = |stage: &Stage, capabilities| -> Vec<String> {
            let module = parse(stage.name, &stage.source(), capabilities).unwrap_or_else(|e| panic!("{e}"));
            let bindings =
                module.global_variables.iter().filter_map(|(_, variable)| variable.binding.map(|b| (b, variable)));
            let mut all: Vec<String> = bindings.map(|(at, variable)| format!("{at:?} {:?}", variable.space)).collect();
            all.sort();
            all
        };
        assert_eq!(bindings(portable, Capabilities::empty()), bindings(stage, HALF_CAPABILITIES), "{}", stage.name);
        assert!(
            parse(stage.name, &stage.source(), Capabilities::empty()).is_err(),
            "{} uses no optional capability",
            stage.name
        );
    }
}

#[test]
fn a_wrong_layout_and_an_invalid_stage_are_detected() {
    let moved = "struct SplatSet { count: u32, first: u32, stride: u32, sh_degree: u32, }
        @group(0) @binding(0) var<uniform> s: SplatSet;
        @compute @workgroup_size(1) fn main() { let x = s.count; }";
    let module = parse("moved", moved, Capabilities::empty()).unwrap_or_else(|e| panic!("{e}"));
    assert_ne!(struct_layouts(&module)["SplatSet"], rust_layouts()["SplatSet"]);
    assert!(parse("untyped", "fn f() -> u32 { return 1.5; }", Capabilities::empty()).is_err());
}

/// `const NAME: u32 = value;` lines of all stages agree with the Rust constants of the same name.
#[test]
fn wgsl_constants_match_rust() {
    let expected: BTreeMap<&str, u32> = [
        ("WORKGROUP_SIZE", shaders::WORKGROUP_SIZE),
        ("TILE", shaders::TILE),
        ("MOMENTS", shaders::MOMENTS),
        ("MAX_VIEWS", shaders::MAX_VIEWS as u32),
        ("SCAN_BLOCK", shaders::SCAN_BLOCK),
        ("RADIX_BLOCK", shaders::RADIX_BLOCK),
        ("RADIX_BINS", shaders::RADIX_BINS),
        ("POSE_BLOCKS", shaders::POSE_BLOCKS),
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
            // `scan` and `radix` both name their constant BLOCK.
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
    assert_eq!(found, expected, "constants missing from every stage");
}
