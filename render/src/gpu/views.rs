//! The uniform `Views` of a dispatch, from cameras and options.

use bytemuck::Zeroable;
use scene::{Camera, Rigid};
use shaders::{MAX_VIEWS, TILE, View, Views};

use super::error::GpuError;
use crate::Options;

/// Views of these cameras over so many trainable and context splats. Fails if the number of cameras is not in
/// 1..=[`MAX_VIEWS`], or if a buffer would exceed `max_binding_bytes`.
pub(super) fn views_of(
    cameras: &[Camera],
    options: &Options,
    [trainable, context]: [usize; 2],
    pair_capacity: usize,
    max_binding_bytes: u64,
) -> Result<Views, GpuError> {
    let count = cameras.len();
    if count == 0 || count > MAX_VIEWS {
        return Err(GpuError::Failed(format!("a dispatch takes 1 to {MAX_VIEWS} views, not {count}")));
    }
    let limit = max_binding_bytes;
    let entries = |splats: usize| {
        let bytes = 4 * count as u64 * splats as u64;
        let fits = u32::try_from(count * splats).ok().filter(|_| bytes <= limit);
        fits.ok_or(GpuError::TooLarge { what: "visible".into(), bytes, limit })
    };
    let area = |camera: &Camera| u64::from(camera.pinhole.width) * u64::from(camera.pinhole.height);
    // Five planes of upstream gradients are the largest image buffer. The bound also keeps pixel and tile counts within
    // 32 bits.
    let bytes = 20 * cameras.iter().map(area).sum::<u64>();
    if bytes > limit {
        return Err(GpuError::TooLarge { what: "upstream".into(), bytes, limit });
    }
    let mut views = Views {
        background: [options.background[0], options.background[1], options.background[2], 0.0],
        count: count as u32,
        trainable_entries: entries(trainable)?,
        entries: entries(trainable + context)?,
        pair_capacity: pair_capacity as u32,
        antialiased: options.antialiased.into(),
        extras: if options.inverse_depth { 2 } else { 1 } * u32::from(options.extras),
        ..Views::zeroed()
    };
    for (view, camera) in views.view.iter_mut().zip(cameras) {
        *view = View { first_tile: views.tiles, first_pixel: views.pixels, ..view_of(camera) };
        views.tiles += view.tiles[0] * view.tiles[1];
        views.pixels += view.pixels[0] * view.pixels[1];
    }
    Ok(views)
}

/// The same views, from these poses instead of the cameras'; nothing displaces them.
pub(super) fn seen_from(views: &Views, cameras: &[Camera], poses: &[Rigid]) -> Views {
    let mut own = *views;
    for ((view, camera), pose) in own.view.iter_mut().zip(cameras).zip(poses) {
        let View { rows, centre, .. } = view_of(&Camera { camera_from_world: *pose, ..*camera });
        *view = View { rows, centre, displacement: 0, ..*view };
    }
    own
}

fn view_of(camera: &Camera) -> View {
    let k = &camera.pinhole;
    let rows = camera.rotation().transpose().to_cols_array_2d();
    let translation = camera.camera_from_world.translation.to_array();
    // gsplat clamps x/z and y/z of the Jacobian to the view and 15 % of the image beyond.
    let guard = |length: u32, focal: f64| 0.15 * f64::from(length) / focal;
    let (guard_x, guard_y) = (guard(k.width, k.fx), guard(k.height, k.fy));
    let centre = camera.centre().as_vec3();
    View {
        rows: std::array::from_fn(|r| [rows[r][0] as f32, rows[r][1] as f32, rows[r][2] as f32, translation[r] as f32]),
        centre: [centre.x, centre.y, centre.z, 0.0],
        focal: [k.fx as f32, k.fy as f32],
        principal: [k.cx as f32, k.cy as f32],
        cone_min: [(-k.cx / k.fx - guard_x) as f32, (-k.cy / k.fy - guard_y) as f32],
        cone_max: [
            ((f64::from(k.width) - k.cx) / k.fx + guard_x) as f32,
            ((f64::from(k.height) - k.cy) / k.fy + guard_y) as f32,
        ],
        pixels: [k.width, k.height],
        tiles: [k.width.div_ceil(TILE), k.height.div_ceil(TILE)],
        first_tile: 0,
        first_pixel: 0,
        displacement: 0,
        padding: 0,
    }
}
