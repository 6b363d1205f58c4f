//! Draws a plan over its capture as an SVG, for review before training.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use glam::{DVec2, DVec3};
use scene::{BlockId, Camera, Capture};

use crate::ground::{Ground, Square, robust_box};
use crate::plan::{Mode, Plan, Task};
use crate::visibility::is_usable;

/// Layout of the page, SVG units: side of the map, width of the panel beside it, margins and title height.
const MAP: f64 = 1000.0;
const PANEL: f64 = 380.0;
const MARGIN: f64 = 40.0;
const TITLE: f64 = 64.0;
/// Maximum number of points drawn.
const MAX_POINTS: usize = 20_000;
/// Maximum number of cameras drawn.
const MAX_VIEWS: usize = 3_000;
const TRAIN: &str = "#1467a8";
const TEST: &str = "#d9480f";
const INK: &str = "#22262b";
const SOFT: &str = "#6b737c";
/// Colours of block outlines by height above the finest level.
const LEVEL_COLOURS: [&str; 5] = ["#0b7a53", "#8a3ffc", "#b0206b", "#7a5b00", "#4a5568"];

/// Draws a plan as an SVG: points, cameras, blocks with their views and splats, a table of levels, a scale bar and a
/// legend.
pub fn draw(plan: &Plan, capture: &Capture) -> String {
    let map = Map::of(plan, capture);
    let (width, height) = (MAP + PANEL + 3.0 * MARGIN, MAP + 2.0 * MARGIN + TITLE);
    let mut svg = Svg(String::new());
    svg.line(format_args!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"Helvetica, Arial, sans-serif\" fill=\"{INK}\">"
    ));
    svg.line(format_args!("<rect width=\"{width}\" height=\"{height}\" fill=\"#fbfaf7\"/>"));
    svg.line(format_args!(
        "<defs><clipPath id=\"map\"><rect x=\"{MARGIN}\" y=\"{}\" width=\"{MAP}\" height=\"{MAP}\"/></clipPath></defs>",
        MARGIN + TITLE
    ));
    draw_title(&mut svg, plan, capture);
    svg.line(format_args!(
        "<rect x=\"{MARGIN}\" y=\"{}\" width=\"{MAP}\" height=\"{MAP}\" fill=\"#ffffff\" stroke=\"#d8d5cc\"/>",
        MARGIN + TITLE
    ));
    svg.line(format_args!("<g clip-path=\"url(#map)\">"));
    draw_points(&mut svg, &map, capture);
    draw_cameras(&mut svg, &map, plan, capture);
    draw_blocks(&mut svg, &map, plan);
    svg.line(format_args!("</g>"));
    draw_scale_bar(&mut svg, &map);
    draw_panel(&mut svg, plan);
    svg.line(format_args!("</svg>"));
    svg.0
}

struct Svg(String);

impl Svg {
    fn line(&mut self, text: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = writeln!(self.0, "{text}");
    }

    /// Writes text; `style` holds further attributes.
    fn text(&mut self, at: DVec2, size: f64, style: &str, text: &str) {
        let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
        self.line(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.1}\" {style}>{text}</text>",
            at.x, at.y
        ));
    }

    /// Writes centred text with a white outline for legibility. The text is written twice because some viewers do not
    /// support `paint-order`.
    fn outlined_text(&mut self, at: DVec2, size: f64, style: &str, text: &str) {
        let rim = "stroke=\"#ffffff\" stroke-width=\"4\" stroke-linejoin=\"round\" stroke-opacity=\"0.9\"";
        self.text(at, size, &format!("text-anchor=\"middle\" {rim} {style}"), text);
        self.text(at, size, &format!("text-anchor=\"middle\" {style}"), text);
    }
}

/// The mapping of ground metres to SVG units.
struct Map {
    ground: Ground,
    centre: DVec2,
    units_per_metre: f64,
}

impl Map {
    /// A map of the root square and the cameras; cameras far outside are cropped.
    fn of(plan: &Plan, capture: &Capture) -> Self {
        let ground = plan.ground;
        let Square { mut min, mut max } = ground.core(BlockId::ROOT);
        let cameras = capture.views.iter().map(|v| &v.camera).filter(|c| is_usable(c));
        let centres: Vec<DVec3> = cameras.map(Camera::centre).filter(|c| c.is_finite()).collect();
        if let Some((low, high)) = robust_box(&centres, |c| ground.from_world(c)) {
            let reach = 0.5 * ground.edge_metres;
            (min, max) = (min.min(low.truncate().max(min - reach)), max.max(high.truncate().min(max + reach)));
        }
        let side = (max - min).max_element() * 1.04;
        Self { ground, centre: (min + max) * 0.5, units_per_metre: MAP / side }
    }

    fn at(&self, ground: DVec2) -> DVec2 {
        let d = (ground - self.centre) * self.units_per_metre;
        DVec2::new(MARGIN + 0.5 * MAP + d.x, MARGIN + TITLE + 0.5 * MAP - d.y)
    }

    fn world(&self, world: DVec3) -> DVec2 {
        self.at(self.ground.from_world(world).truncate())
    }

    /// The upper left corner of a square on the page, and its side.
    fn square(&self, square: &Square) -> (DVec2, f64) {
        (self.at(DVec2::new(square.min.x, square.max.y)), (square.max.x - square.min.x) * self.units_per_metre)
    }

    fn contains(&self, at: DVec2) -> bool {
        let inside = DVec2::new(at.x - MARGIN, at.y - MARGIN - TITLE);
        inside.cmpge(DVec2::ZERO).all() && inside.cmple(DVec2::splat(MAP)).all()
    }
}

fn draw_title(svg: &mut Svg, plan: &Plan, capture: &Capture) {
    let mode = match plan.settings.mode {
        Mode::Tree => "tree",
        Mode::Flat => "flat",
        Mode::Whole => "whole",
    };
    let id = plan.id().to_string();
    let name = format!("Plan {} · {mode} · {} blocks", &id[..12], plan.tasks.len());
    svg.text(DVec2::new(MARGIN, MARGIN + 14.0), 24.0, "font-weight=\"bold\"", &name);
    let edge = plan.ground.edge_metres;
    let facts = format!(
        "{} views · {} sparse points · {} m × {} m · {} splats · backend {}",
        capture.views.len(),
        grouped(capture.points.len() as u64),
        short(edge),
        short(edge),
        grouped(u64::from(plan.settings.budget)),
        plan.backend
    );
    svg.text(DVec2::new(MARGIN, MARGIN + 40.0), 14.0, &format!("fill=\"{SOFT}\""), &facts);
}

/// Draws sparse points with quantised colours (four bits per channel), as one path of dots per colour.
fn draw_points(svg: &mut Svg, map: &Map, capture: &Capture) {
    let points = &capture.points;
    let mut by_colour: BTreeMap<[u8; 3], String> = BTreeMap::new();
    for i in (0..points.len()).step_by(points.len().div_ceil(MAX_POINTS).max(1)) {
        let at = map.world(points.positions[i]);
        if map.contains(at) {
            // Brightness is limited so that white points are visible on the white map.
            let colour = points.colours.get(i).map_or([90; 3], |c| c.map(|v| (v.min(215) >> 4) * 17));
            let _ = write!(by_colour.entry(colour).or_default(), "M{:.1} {:.1}h0", at.x, at.y);
        }
    }
    let size = (300.0 / (points.len() as f64).sqrt()).clamp(1.8, 5.0);
    svg.line(format_args!(
        "<g fill=\"none\" stroke-width=\"{size:.1}\" stroke-linecap=\"round\" stroke-opacity=\"0.75\">"
    ));
    for ([r, g, b], path) in by_colour {
        svg.line(format_args!("<path stroke=\"#{r:02x}{g:02x}{b:02x}\" d=\"{path}\"/>"));
    }
    svg.line(format_args!("</g>"));
}

/// Draws cameras as small pyramids, seen from above.
fn draw_cameras(svg: &mut Svg, map: &Map, plan: &Plan, capture: &Capture) {
    let views = &capture.views;
    let size = (9.0 + 160.0 / (1.0 + views.len() as f64).sqrt()).min(34.0) / map.units_per_metre;
    for (i, view) in views.iter().enumerate().step_by(views.len().div_ceil(MAX_VIEWS).max(1)) {
        if is_usable(&view.camera) {
            let test = Capture::is_test(i, plan.settings.test_every);
            let (colour, fill) = if test { (TEST, 0.30) } else { (TRAIN, 0.14) };
            let [apex, corners @ ..] = pyramid(&view.camera, size).map(|p| map.world(p));
            if map.contains(apex) {
                wedge(svg, apex, corners, colour, fill);
            }
        }
    }
}

/// The camera centre and the four image corners in cyclic order, at this distance from the centre.
fn pyramid(camera: &Camera, size_metres: f64) -> [DVec3; 5] {
    let (k, back) = (&camera.pinhole, camera.camera_from_world.inverse());
    let corner = |u: f64, v: f64| {
        let ray = DVec3::new((u * f64::from(k.width) - k.cx) / k.fx, (v * f64::from(k.height) - k.cy) / k.fy, 1.0);
        back.apply(ray.normalize_or_zero() * size_metres)
    };
    [back.translation, corner(0.0, 0.0), corner(1.0, 0.0), corner(1.0, 1.0), corner(0.0, 1.0)]
}

fn wedge(svg: &mut Svg, apex: DVec2, corners: [DVec2; 4], colour: &str, fill: f64) {
    let mut path = String::new();
    for (i, c) in corners.iter().enumerate() {
        let _ = write!(path, "{}{:.1} {:.1}", if i == 0 { "M" } else { "L" }, c.x, c.y);
    }
    path.push('Z');
    for c in corners {
        let _ = write!(path, "M{:.1} {:.1}L{:.1} {:.1}", apex.x, apex.y, c.x, c.y);
    }
    svg.line(format_args!(
        "<path d=\"{path}\" fill=\"{colour}\" fill-opacity=\"{fill}\" stroke=\"{colour}\" stroke-width=\"0.8\" stroke-opacity=\"0.8\"/>"
    ));
    svg.line(format_args!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.8\" fill=\"{colour}\"/>", apex.x, apex.y));
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

/// Draws a scale bar of a round length, about a fifth of the map.
fn draw_scale_bar(svg: &mut Svg, map: &Map) {
    let rough = 0.2 * MAP / map.units_per_metre;
    let power = 10f64.powf(rough.log10().floor());
    let metres = [5.0, 2.0, 1.0].into_iter().map(|k| k * power).find(|&m| m <= rough).unwrap_or(power);
    let (x, y, length) = (MARGIN + 20.0, MARGIN + TITLE + MAP - 22.0, metres * map.units_per_metre);
    svg.line(format_args!(
        "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"42\" rx=\"4\" fill=\"#ffffff\" fill-opacity=\"0.85\"/>",
        x - 10.0,
        y - 28.0,
        length + 20.0
    ));
    svg.line(format_args!(
        "<path d=\"M{x:.1} {:.1}V{y:.1}H{:.1}V{:.1}\" fill=\"none\" stroke=\"{INK}\" stroke-width=\"2\"/>",
        y - 7.0,
        x + length,
        y - 7.0
    ));
    svg.text(DVec2::new(x + 0.5 * length, y - 10.0), 14.0, "text-anchor=\"middle\"", &format!("{} m", short(metres)));
}

/// Draws the table of levels and the legend.
fn draw_panel(svg: &mut Svg, plan: &Plan) {
    let x = 2.0 * MARGIN + MAP;
    let mut y = MARGIN + TITLE + 16.0;
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
    let glyph = |svg: &mut Svg, y: f64, colour: &str, fill: f64| {
        let (apex, c) = (DVec2::new(x + 4.0, y - 4.0), |dx: f64, dy: f64| DVec2::new(x + 22.0 + dx, y - 4.0 + dy));
        wedge(svg, apex, [c(0.0, -9.0), c(3.0, -5.0), c(3.0, 5.0), c(0.0, 9.0)], colour, fill);
    };
    let mut entry = |svg: &mut Svg, text: &str| {
        y += 26.0;
        svg.text(DVec2::new(x + 38.0, y), 14.0, "", text);
        y
    };
    let at = entry(svg, "training camera");
    glyph(svg, at, TRAIN, 0.14);
    let at = entry(svg, "held-out camera");
    glyph(svg, at, TEST, 0.30);
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
    for (dx, dy, colour) in
        [(6.0, -6.0, "#887766"), (13.0, -2.0, "#446633"), (19.0, -8.0, "#994433"), (22.0, 0.0, "#555555")]
    {
        svg.line(format_args!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.6\" fill=\"{colour}\"/>", x + dx, at + dy));
    }
}

/// Formats a number with thin spaces between thousands.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push('\u{2009}');
        }
        text.push(digit);
    }
    text
}

/// Formats a number with about three significant digits.
fn short(value: f64) -> String {
    let decimals = (2.0 - value.abs().max(1e-9).log10().floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
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

    #[test]
    fn numbers_are_formatted() {
        assert_eq!([0.0, 0.012_345, 1.0, 153.296, 2e6].map(short), ["0", "0.0123", "1", "153", "2000000"]);
        assert_eq!([0, 999, 1000, 1_234_567].map(grouped), ["0", "999", "1\u{2009}000", "1\u{2009}234\u{2009}567"]);
    }
}
