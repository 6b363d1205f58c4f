//! Draws a plan over its capture as an SVG, for review before training.

use std::collections::BTreeSet;

use glam::DVec2;
use scene::{BlockId, Capture};

use crate::page::{
    Map, SOFT, Svg, camera_glyph, draw_cameras, draw_points, facts_of, grouped, page, panel_corner, points_glyph, short,
};
use crate::plan::{Mode, Plan};
use crate::split::Split;
use crate::task::Task;

const TRAIN: &str = "#1467a8";
const TEST: &str = "#d9480f";
/// Colours of block outlines by height above the finest level.
const LEVEL_COLOURS: [&str; 5] = ["#0b7a53", "#8a3ffc", "#b0206b", "#7a5b00", "#4a5568"];

/// Draws a plan as an SVG: points, cameras, blocks with their views and splats, a table of levels, a scale bar and a
/// legend.
pub fn draw(plan: &Plan, capture: &Capture) -> String {
    let mode = match plan.settings.mode {
        Mode::Tree => "tree",
        Mode::Flat => "flat",
        Mode::Whole => "whole",
    };
    let id = plan.id().to_string();
    let title = format!("Plan {} · {mode} · {} blocks", &id[..12], plan.tasks.len());
    let facts = format!(
        "{} · {} splats · backend {}",
        facts_of(capture, &plan.ground),
        grouped(u64::from(plan.settings.budget)),
        plan.backend
    );
    let split = Split::of(plan, capture);
    let style = |view: usize| if split.is_held_out(view as u32) { (TEST, 0.30) } else { (TRAIN, 0.14) };
    let on_map = |svg: &mut Svg, map: &Map| {
        draw_points(svg, map, capture);
        draw_cameras(svg, map, capture, style);
        draw_blocks(svg, map, plan);
    };
    page(&Map::of(&plan.ground, capture), &title, &facts, on_map, |svg| draw_panel(svg, plan))
}

fn colour_of(plan: &Plan, level: u8) -> &'static str {
    LEVEL_COLOURS[usize::from(plan.levels - level.min(plan.levels)).min(LEVEL_COLOURS.len() - 1)]
}

/// Draws the cores of all tasks and the labels. Finer blocks come first, so that coarser outlines lie on top.
fn draw_blocks(svg: &mut Svg, map: &Map, plan: &Plan) {
    for task in plan.tasks.iter().rev() {
        let above = plan.levels - task.block.level;
        let (at, side) = map.square(&map.ground.core(task.block));
        let (inset, width) = (f64::from(above) * 1.5, 1.4 + 1.2 * f64::from(above));
        let (colour, dash) =
            (colour_of(plan, task.block.level), if above > 0 { " stroke-dasharray=\"10 5\"" } else { "" });
        svg.line(format_args!(
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width:.1}\"{dash}/>",
            at.x - inset, at.y - inset, side + 2.0 * inset, side + 2.0 * inset
        ));
    }
    if let Some(task) = halo_example(plan) {
        let (at, side) = map.square(&map.ground.nominal_halo(task.block));
        let (x, y, colour) = (at.x, at.y, colour_of(plan, plan.levels));
        svg.line(format_args!(
            "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{side:.1}\" height=\"{side:.1}\" fill=\"{colour}\" \
             fill-opacity=\"0.07\" stroke=\"{colour}\" stroke-dasharray=\"3 3\"/>"
        ));
    }
    let parents: BTreeSet<BlockId> = plan.tasks.iter().filter_map(|t| t.parent).collect();
    for task in &plan.tasks {
        label(svg, map, plan, task, parents.contains(&task.block));
    }
}

/// The finest block nearest to the centre. Only its halo is drawn.
fn halo_example(plan: &Plan) -> Option<&Task> {
    let middle = plan.ground.core(BlockId::ROOT).centre();
    let distance = |t: &&Task| plan.ground.core(t.block).centre().distance_squared(middle);
    let leaves = plan.tasks.iter().filter(|t| t.block.level == plan.levels && plan.levels > 0);
    leaves.min_by(|a, b| distance(a).total_cmp(&distance(b)))
}

/// Labels a block with its id. A block without children also gets its views, splats and steps.
fn label(svg: &mut Svg, map: &Map, plan: &Plan, task: &Task, has_children: bool) {
    let (corner, side) = map.square(&map.ground.core(task.block));
    let colour = colour_of(plan, task.block.level);
    if has_children {
        // Only the two levels above the finest are labelled, because coarser labels would overlap.
        let above = f64::from(plan.levels - task.block.level);
        if above <= 2.0 {
            let at = DVec2::new(corner.x + 0.5 * side, corner.y + 14.0 * above + 4.0);
            svg.outlined_text(at, 12.0, &format!("font-weight=\"bold\" fill=\"{colour}\""), &task.block.to_string());
        }
        return;
    }
    let size = (side / 9.0).min(16.0);
    let centre = corner + 0.5 * side;
    let lines = [
        task.block.to_string(),
        format!("{} + {} views", task.views.len(), task.test_views.len()),
        format!("{} splats", grouped(u64::from(task.budget))),
        format!("{} steps", grouped(u64::from(task.steps))),
    ];
    for (i, line) in lines.iter().enumerate() {
        let weight = if i == 0 { "bold" } else { "normal" };
        let style = format!("font-weight=\"{weight}\" fill=\"{colour}\"");
        svg.outlined_text(centre + DVec2::new(0.0, (i as f64 - 1.1) * 1.3 * size), size, &style, line);
    }
}

/// Draws the table of levels and the legend.
fn draw_panel(svg: &mut Svg, plan: &Plan) {
    let DVec2 { x, mut y } = panel_corner();
    svg.text(DVec2::new(x, y), 16.0, "font-weight=\"bold\"", "Levels");
    let columns =
        [("level", 40.0), ("blocks", 95.0), ("m/pixel", 165.0), ("splats", 240.0), ("windows", 310.0), ("MiB", 375.0)];
    let right = |svg: &mut Svg, y: f64, values: [String; 6], style: &str| {
        for ((_, at), value) in columns.iter().zip(values) {
            svg.text(DVec2::new(x + at, y), 13.0, &format!("text-anchor=\"end\" {style}"), &value);
        }
    };
    y += 24.0;
    right(svg, y, columns.map(|(name, _)| name.to_string()), &format!("fill=\"{SOFT}\""));
    for level in 0..=plan.levels {
        let tasks: Vec<&Task> = plan.tasks.iter().filter(|t| t.block.level == level).collect();
        let (Some(memory), Some(rho)) =
            (tasks.iter().map(|t| t.memory_bytes).max(), plan.rho_metres.get(usize::from(level)))
        else {
            continue;
        };
        y += 20.0;
        let colour = colour_of(plan, level);
        svg.line(format_args!(
            "<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"12\" height=\"12\" fill=\"{colour}\"/>",
            y - 11.0
        ));
        let values = [
            level.to_string(),
            tasks.len().to_string(),
            short(*rho),
            grouped(tasks.iter().map(|t| u64::from(t.budget)).sum()),
            grouped(tasks.iter().map(|t| t.views.len() as u64).sum()),
            grouped(memory.div_ceil(1 << 20)),
        ];
        right(svg, y, values, "");
    }
    y += 44.0;
    svg.text(DVec2::new(x, y), 16.0, "font-weight=\"bold\"", "Legend");
    let mut entry = |svg: &mut Svg, text: &str| {
        y += 26.0;
        svg.text(DVec2::new(x + 38.0, y), 14.0, "", text);
        y
    };
    let at = entry(svg, "training camera");
    camera_glyph(svg, DVec2::new(x + 4.0, at - 4.0), TRAIN, 0.14);
    let at = entry(svg, "held-out camera");
    camera_glyph(svg, DVec2::new(x + 4.0, at - 4.0), TEST, 0.30);
    let boxed = |svg: &mut Svg, y: f64, level: u8, style: &str| {
        let colour = colour_of(plan, level);
        svg.line(format_args!(
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"22\" height=\"16\" stroke=\"{colour}\" {style}/>",
            x + 3.0,
            y - 13.0
        ));
    };
    let at = entry(svg, "block core: training + held-out views");
    boxed(svg, at, plan.levels, "fill=\"none\" stroke-width=\"1.4\"");
    if let Some(coarsest) = plan.tasks.first().map(|t| t.block.level).filter(|&level| level < plan.levels) {
        let at = entry(svg, "block of a coarser level");
        boxed(svg, at, coarsest, "fill=\"none\" stroke-width=\"2.5\" stroke-dasharray=\"6 3\"");
    }
    if halo_example(plan).is_some() {
        let at = entry(svg, "halo of one block");
        let style = format!("fill=\"{}\" fill-opacity=\"0.07\" stroke-dasharray=\"3 3\"", colour_of(plan, plan.levels));
        boxed(svg, at, plan.levels, &style);
    }
    let at = entry(svg, "sparse points");
    points_glyph(svg, DVec2::new(x, at));
}

#[cfg(test)]
mod tests {
    use scene::ArtefactId;

    use super::*;
    use crate::plan::PlanSettings;
    use crate::testing::aerial;

    #[test]
    fn every_block_and_camera_is_drawn() {
        let capture = aerial(5, 200.0, 3000);
        let settings = PlanSettings { levels: Some(1), ..PlanSettings::default() };
        let plan = crate::plan(&capture, ArtefactId::of(b""), &settings, "a<b&c").unwrap();
        let svg = draw(&plan, &capture);
        for task in &plan.tasks {
            assert!(svg.contains(&format!(">{}</text>", task.block)), "{}", task.block);
        }
        // One dot per camera and one in the legend.
        assert_eq!(svg.matches(&format!("r=\"1.8\" fill=\"{TRAIN}\"")).count(), 21 + 1);
        assert_eq!(svg.matches(&format!("r=\"1.8\" fill=\"{TEST}\"")).count(), 4 + 1);
        assert!(svg.contains("backend a&lt;b&amp;c") && svg.trim_end().ends_with("</svg>"));
        assert_eq!(svg.matches("<g").count(), svg.matches("</g>").count());
        assert_eq!(svg, draw(&plan, &capture));
    }
}
