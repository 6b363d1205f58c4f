//! A page with a map of a capture, as SVG: frame, points, cameras, scale bar. What is drawn on the map and written beside it is the
//! caller's.

use std::collections::BTreeMap;
use std::fmt::Write;

use glam::{DVec2, DVec3};
use scene::{BlockId, Camera, Capture};

use crate::ground::{Ground, Square, robust_box};
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
pub(crate) const INK: &str = "#22262b";
pub(crate) const SOFT: &str = "#6b737c";

/// Draws the page: a title with a line of facts, a map with a scale bar, a panel beside it.
pub(crate) fn page(
    map: &Map,
    title: &str,
    facts: &str,
    on_map: impl FnOnce(&mut Svg, &Map),
    panel: impl FnOnce(&mut Svg),
) -> String {
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
    svg.text(DVec2::new(MARGIN, MARGIN + 14.0), 24.0, "font-weight=\"bold\"", title);
    svg.text(DVec2::new(MARGIN, MARGIN + 40.0), 14.0, &format!("fill=\"{SOFT}\""), facts);
    svg.line(format_args!(
        "<rect x=\"{MARGIN}\" y=\"{}\" width=\"{MAP}\" height=\"{MAP}\" fill=\"#ffffff\" stroke=\"#d8d5cc\"/>",
        MARGIN + TITLE
    ));
    svg.line(format_args!("<g clip-path=\"url(#map)\">"));
    on_map(&mut svg, map);
    svg.line(format_args!("</g>"));
    draw_scale_bar(&mut svg, map);
    panel(&mut svg);
    svg.line(format_args!("</svg>"));
    svg.0
}

/// The upper left corner of the panel's text.
pub(crate) fn panel_corner() -> DVec2 {
    DVec2::new(2.0 * MARGIN + MAP, MARGIN + TITLE + 16.0)
}

/// Views, points and extent of a capture, in a line.
pub(crate) fn facts_of(capture: &Capture, ground: &Ground) -> String {
    let (views, points, edge) = (capture.views.len(), grouped(capture.points.len() as u64), short(ground.edge_metres));
    format!("{views} views · {points} sparse points · {edge} m × {edge} m")
}

pub(crate) struct Svg(String);

impl Svg {
    pub(crate) fn line(&mut self, text: std::fmt::Arguments<'_>) {
        // Writing to a String cannot fail.
        let _ = writeln!(self.0, "{text}");
    }

    /// Writes text; `style` holds further attributes.
    pub(crate) fn text(&mut self, at: DVec2, size: f64, style: &str, text: &str) {
        let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
        self.line(format_args!(
            "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.1}\" {style}>{text}</text>",
            at.x, at.y
        ));
    }

    /// Writes centred text with a white outline for legibility. The text is written twice because some viewers do not
    /// support `paint-order`.
    pub(crate) fn outlined_text(&mut self, at: DVec2, size: f64, style: &str, text: &str) {
        let rim = "stroke=\"#ffffff\" stroke-width=\"4\" stroke-linejoin=\"round\" stroke-opacity=\"0.9\"";
        self.text(at, size, &format!("text-anchor=\"middle\" {rim} {style}"), text);
        self.text(at, size, &format!("text-anchor=\"middle\" {style}"), text);
    }
}

/// The mapping of ground metres to SVG units.
pub(crate) struct Map {
    pub(crate) ground: Ground,
    centre: DVec2,
    units_per_metre: f64,
}

impl Map {
    /// A map of the root square and the cameras; cameras far outside are cropped.
    pub(crate) fn of(ground: &Ground, capture: &Capture) -> Self {
        let ground = *ground;
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

    pub(crate) fn world(&self, world: DVec3) -> DVec2 {
        self.at(self.ground.from_world(world).truncate())
    }

    /// The upper left corner of a square on the page, and its side.
    pub(crate) fn square(&self, square: &Square) -> (DVec2, f64) {
        (self.at(DVec2::new(square.min.x, square.max.y)), (square.max.x - square.min.x) * self.units_per_metre)
    }

    fn contains(&self, at: DVec2) -> bool {
        let inside = DVec2::new(at.x - MARGIN, at.y - MARGIN - TITLE);
        inside.cmpge(DVec2::ZERO).all() && inside.cmple(DVec2::splat(MAP)).all()
    }
}

/// Draws sparse points with quantised colours (four bits per channel), as one path of dots per colour.
pub(crate) fn draw_points(svg: &mut Svg, map: &Map, capture: &Capture) {
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

/// Draws cameras as small pyramids, seen from above. `style` gives a view's colour and the opacity of its filling.
pub(crate) fn draw_cameras(svg: &mut Svg, map: &Map, capture: &Capture, style: impl Fn(usize) -> (&'static str, f64)) {
    let views = &capture.views;
    let size = (9.0 + 160.0 / (1.0 + views.len() as f64).sqrt()).min(34.0) / map.units_per_metre;
    for (i, view) in views.iter().enumerate().step_by(views.len().div_ceil(MAX_VIEWS).max(1)) {
        if is_usable(&view.camera) {
            let (colour, fill) = style(i);
            let [apex, corners @ ..] = pyramid(&view.camera, size).map(|p| map.world(p));
            if map.contains(apex) {
                wedge(svg, apex, corners, colour, fill);
            }
        }
    }
}

/// Draws a camera of the legend, its apex at this place.
pub(crate) fn camera_glyph(svg: &mut Svg, apex: DVec2, colour: &str, fill: f64) {
    let corners = [[18.0, -9.0], [21.0, -5.0], [21.0, 5.0], [18.0, 9.0]].map(|at| apex + DVec2::from_array(at));
    wedge(svg, apex, corners, colour, fill);
}

/// Draws the sparse points of the legend beside this place.
pub(crate) fn points_glyph(svg: &mut Svg, at: DVec2) {
    let dots = [(6.0, -6.0, "#887766"), (13.0, -2.0, "#446633"), (19.0, -8.0, "#994433"), (22.0, 0.0, "#555555")];
    for (dx, dy, colour) in dots {
        svg.line(format_args!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1.6\" fill=\"{colour}\"/>", at.x + dx, at.y + dy));
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

/// Formats a number with thin spaces between thousands.
pub(crate) fn grouped(number: u64) -> String {
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
pub(crate) fn short(value: f64) -> String {
    let decimals = (2.0 - value.abs().max(1e-9).log10().floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_formatted() {
        assert_eq!([0.0, 0.012_345, 1.0, 153.296, 2e6].map(short), ["0", "0.0123", "1", "153", "2000000"]);
        assert_eq!([0, 999, 1000, 1_234_567].map(grouped), ["0", "999", "1\u{2009}000", "1\u{2009}234\u{2009}567"]);
    }
}
