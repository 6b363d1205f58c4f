//! Frozen parts in axes of their own: drawn where their pose puts them, and without effect on what the pose leaves alone.

mod reference;

use glam::{DQuat, DVec3};
use reference::{Random, camera};
use render::cpu::Renderer;
use render::{Options, Part, Upstream};
use scene::{Camera, Rigid, Splats, column};

const OPTIONS: Options =
    Options { antialiased: false, sh_degree: 0, background: [0.1, 0.2, 0.3], extras: true, inverse_depth: false };

fn cloud(random: &mut Random, camera: &Camera, count: usize) -> Splats {
    let mut splats = Splats::new(0);
    for _ in 0..count {
        let pixel = [random.range(0.0, 60.0), random.range(0.0, 44.0)];
        let (depth, sigma) = (random.range(2.0, 6.0), random.range(0.8, 4.0));
        splats.push(&random.splat(camera, pixel, depth, sigma));
    }
    splats
}

/// The splats in axes from which `pose` leads to theirs.
fn in_axes(splats: &Splats, pose: &Rigid) -> Splats {
    let (mut moved, back) = (splats.clone(), pose.inverse());
    for i in 0..splats.len() {
        let mean = back.apply(splats.mean(i).as_dvec3());
        let quat = |k: usize| f64::from(splats.col(column::QUAT + k)[i]);
        let turned = back.rotation * DQuat::from_xyzw(quat(1), quat(2), quat(3), quat(0)).normalize();
        for (k, value) in [mean.x, mean.y, mean.z].into_iter().enumerate() {
            moved.columns_mut()[column::MEAN + k][i] = value as f32;
        }
        for (k, value) in [turned.w, turned.x, turned.y, turned.z].into_iter().enumerate() {
            moved.columns_mut()[column::QUAT + k][i] = value as f32;
        }
    }
    moved
}

fn pose(turn: f64, place: DVec3) -> Rigid {
    Rigid { rotation: DQuat::from_rotation_y(turn) * DQuat::from_rotation_x(0.3), translation: place }
}

#[test]
fn parts_are_drawn_where_their_poses_put_them() {
    let camera = camera(60, 44, 50.0);
    let mut random = Random(5);
    let own = cloud(&mut random, &camera, 21);
    let parts = [cloud(&mut random, &camera, 18), cloud(&mut random, &camera, 33)];
    let poses = [pose(0.7, DVec3::new(4.0, -2.0, 1.0)), pose(-2.0, DVec3::new(-30.0, 8.0, 12.0))];
    let moved = [0, 1].map(|k| in_axes(&parts[k], &poses[k]));
    let area = 60 * 44;
    let upstream = Upstream {
        colour: random.plane(3 * area),
        transmittance: random.plane(area),
        depth: random.plane(area),
        trainable_alpha: random.plane(area),
    };
    let draw = |parts: &[Part]| {
        let mut renderer = Renderer::default();
        let frame = renderer.forward(&own, parts, &camera, &OPTIONS).clone();
        (frame, renderer.backward(&own, &upstream).clone())
    };
    let beside = draw(&[Part::beside(&parts[0]), Part::beside(&parts[1])]);
    let posed = draw(
        &[0, 1].map(|k| Part { splats: &moved[k], camera_from_part: Some(camera.camera_from_world.after(&poses[k])) }),
    );
    let worst = |a: &[f32], b: &[f32]| {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    // Rounding of means some ten metres away.
    for (a, b) in [
        (&beside.0.colour, &posed.0.colour),
        (&beside.0.transmittance, &posed.0.transmittance),
        (&beside.0.trainable_alpha, &posed.0.trainable_alpha),
    ] {
        assert!(worst(a, b) < 2e-3, "{}", worst(a, b));
    }
    for (a, b) in beside.1.columns.iter().zip(&posed.1.columns) {
        let largest = a.iter().fold(0.0, |m: f32, v| m.max(v.abs()));
        assert!(worst(a, b) <= 2e-2 * largest, "{} of {largest}", worst(a, b));
    }
    // They matter, and so do their poses.
    let none = draw(&[]);
    let wrong = draw(&[0, 1].map(|k| Part { splats: &moved[k], camera_from_part: None }));
    assert!(worst(&none.0.colour, &posed.0.colour) > 0.1 && worst(&wrong.0.colour, &posed.0.colour) > 0.1);
}

#[test]
fn the_number_and_length_of_parts_do_not_leave_anything_of_earlier_views() {
    let camera = camera(60, 44, 50.0);
    let mut random = Random(9);
    let own = cloud(&mut random, &camera, 17);
    let many: Vec<Splats> = (1..6).map(|n| cloud(&mut random, &camera, 7 * n)).collect();
    let mut used = Renderer::default();
    for count in [5, 0, 2, 5, 1] {
        let parts: Vec<Part> = many[..count].iter().map(Part::beside).collect();
        let fresh = Renderer::default().forward(&own, &parts, &camera, &OPTIONS).clone();
        assert_eq!(used.forward(&own, &parts, &camera, &OPTIONS), &fresh, "{count} parts");
    }
}
