//! Frames of plat: splat columns, exposures, plans, captures. Raw, and with valid lengths and checksum.
#![no_main]

use blocks::{Plan, plan::PLAN};
use libfuzzer_sys::fuzz_target;
use scene::exposures::EXPOSURES;
use scene::poses::POSES;
use scene::swing::{NUMBERS, SWING, Swing};
use scene::{Capture, Exposures, Poses, objects};
use scene::frame::{self, Kind, SPLATS, SPLATS_WITH_ATTRIBUTES, SPLATS_WITH_POSES};

/// The same as `dataset::ingest::CAPTURE`.
const CAPTURE: Kind = Kind(*b"capt", 3);

fuzz_target!(|bytes: &[u8]| {
    let _ = frame::decode::<frame::SplatsHeader>(SPLATS, bytes);
    // A header of splats takes at least three bytes, 66 more with the id of exposures and eight more with a residual.
    for header in 0..bytes.len().min(96) {
        let _ = frame::decode_splats(&sealed(SPLATS, bytes, header));
        let _ = frame::decode_splats(&sealed(SPLATS_WITH_ATTRIBUTES, bytes, header));
        let _ = frame::decode_splats(&sealed(SPLATS_WITH_POSES, bytes, header));
    }
    let _ = Exposures::from_frame(bytes);
    let _ = Poses::from_frame(bytes);
    let object = br#"{"tracks": [{"id": "a", "class": "car", "low": [0, 0, 0], "high": [4, 2, 1],
        "poses": [[0, [0, 0, 0], [0, 0, 0, 1]]]}]}"#;
    let about = objects::read(object).unwrap().objects.remove(0);
    for header in 0..bytes.len().min(10) {
        let _ = objects::from_frame(&sealed(objects::OBJECT, bytes, header), &about);
        let _ = Exposures::from_frame(&sealed(EXPOSURES, bytes, header));
        let _ = Poses::from_frame(&sealed(POSES, bytes, header));
        let _ = Swing::from_frame(&sealed(SWING, bytes, header), bytes.len().saturating_sub(header) / (4 * NUMBERS));
    }
    if let Ok(plan) = Plan::from_frame(&sealed(PLAN, bytes, bytes.len())) {
        plan.leaves();
        for task in &plan.tasks {
            task.window_pixels();
            task.context_cut();
            plan.ground.halo(task.block);
            assert!(plan.task(task.block).is_some());
        }
        for (index, task) in (0..).zip(plan.all_tasks()) {
            assert_eq!(plan.planned(index), Some(task));
            let _ = plan.dependencies(task);
        }
    }
    if let Ok((capture, _)) = frame::decode::<Capture>(CAPTURE, &sealed(CAPTURE, bytes, bytes.len()))
        && capture.check().is_ok()
    {
        let _ = blocks::plan(&capture, scene::ArtefactId::of(bytes), &blocks::PlanSettings::default(), "cpu");
    }
});

/// A frame whose header is the first `header` bytes of `body` and whose bulk is the rest.
fn sealed(kind: Kind, body: &[u8], header: usize) -> Vec<u8> {
    let mut bytes = b"plat".to_vec();
    bytes.extend(kind.0);
    bytes.extend(kind.1.to_le_bytes());
    bytes.extend((header as u32).to_le_bytes());
    bytes.extend(((body.len() - header) as u64).to_le_bytes());
    bytes.extend(&blake3::hash(body).as_bytes()[..16]);
    bytes.extend(body);
    bytes
}
