//! Draws how densely a capture photographs the ground, as an SVG.

use glam::DVec2;
use scene::Capture;

use crate::density::{Cell, Density, ENOUGH_PLACES};
use crate::ground::Ground;
use crate::page::{
    Map, SOFT, Svg, camera_glyph, draw_cameras, draw_points, facts_of, page, panel_corner, points_glyph, short,
};
use crate::view_kind::{ViewKind, view_kinds};

/// Colours by kind: of cameras and of thin ground.
const COLOURS: [(ViewKind, &str, &str); 2] =
    [(ViewKind::Aerial, "#1467a8", "#8a3ffc"), (ViewKind::Street, "#0b7a53", "#d9480f")];

/// Draws points, cameras by kind, and hatched the ground that too few photos of a kind show from nearby, with a legend.
pub fn draw_density(densities: &[Density], capture: &Capture) -> String {
    let (ground, kinds) = (Ground::of(capture), view_kinds(capture));
    let thin: usize = densities.iter().map(Density::thin_cells).sum();
    let title = if thin > 0 { "Where photos are too few" } else { "Photos are dense enough everywhere" };
    let on_map = |svg: &mut Svg, map: &Map| {
        draw_points(svg, map, capture);
        for density in densities {
            let (_, _, colour) = colours_of(density.kind);
            density
                .cells
                .iter()
                .filter(|cell| cell.is_thin())
                .for_each(|cell| draw_thin(svg, map, cell, density.kind, colour));
        }
        draw_cameras(svg, map, capture, |view| (colours_of(kinds[view]).1, 0.14));
    };
    let panel = |svg: &mut Svg| draw_panel(svg, densities);
    page(&Map::of(&ground, capture), title, &facts_of(capture, &ground), on_map, panel)
}

fn colours_of(kind: ViewKind) -> (ViewKind, &'static str, &'static str) {
    COLOURS.into_iter().find(|of| of.0 == kind).unwrap_or(COLOURS[0])
}

fn draw_thin(svg: &mut Svg, map: &Map, cell: &Cell, kind: ViewKind, colour: &str) {
    let (at, side) = map.square(&cell.square);
    hatched(svg, at, DVec2::splat(side), kind, colour);
}

/// A rectangle with three diagonal lines: rising for street views, falling for aerial ones, so that both can overlap.
fn hatched(svg: &mut Svg, at: DVec2, size: DVec2, kind: ViewKind, colour: &str) {
    let DVec2 { x: w, y: h } = size;
    svg.line(format_args!(
        "<rect class=\"thin-{}\" x=\"{:.1}\" y=\"{:.1}\" width=\"{w:.1}\" height=\"{h:.1}\" fill=\"{colour}\" fill-opacity=\"0.22\"/>",
        kind.name(),
        at.x,
        at.y
    ));
    let mut path = String::new();
    for [from, to] in [[[0.0, 0.5], [0.5, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.5, 1.0], [1.0, 0.5]]] {
        let place = |[x, y]: [f64; 2]| at + size * DVec2::new(x, if kind == ViewKind::Street { y } else { 1.0 - y });
        let (a, b) = (place(from), place(to));
        path += &format!("M{:.1} {:.1}L{:.1} {:.1}", a.x, a.y, b.x, b.y);
    }
    svg.line(format_args!(
        "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1\" stroke-opacity=\"0.7\"/>"
    ));
}

/// Draws the figures of each kind and the legend.
fn draw_panel(svg: &mut Svg, densities: &[Density]) {
    let DVec2 { x, mut y } = panel_corner();
    for density in densities {
        let (views, kind) = (density.views, density.kind.name());
        svg.text(DVec2::new(x, y), 16.0, "font-weight=\"bold\"", &format!("{views} {kind} views"));
        let spacing = density.spacing_metres.map_or("-".into(), |metres| format!("{} m apart", short(metres)));
        let cells = format!(
            "{} of {} cells of {} m are thin",
            density.thin_cells(),
            density.cells.len(),
            short(density.cell_metres)
        );
        for line in [spacing, cells] {
            y += 20.0;
            svg.text(DVec2::new(x, y), 13.0, &format!("fill=\"{SOFT}\""), &line);
        }
        y += 34.0;
    }
    svg.text(DVec2::new(x, y), 16.0, "font-weight=\"bold\"", "Legend");
    for density in densities {
        let (_, camera, thin) = colours_of(density.kind);
        let kind = density.kind.name();
        y += 26.0;
        svg.text(DVec2::new(x + 38.0, y), 14.0, "", &format!("{kind} camera"));
        camera_glyph(svg, DVec2::new(x + 4.0, y - 4.0), camera, 0.14);
        y += 26.0;
        let text = format!("{kind} photos from fewer than {ENOUGH_PLACES} near places");
        svg.text(DVec2::new(x + 38.0, y), 14.0, "", &text);
        hatched(svg, DVec2::new(x + 3.0, y - 13.0), DVec2::new(22.0, 16.0), density.kind, thin);
    }
    y += 26.0;
    svg.text(DVec2::new(x + 38.0, y), 14.0, "", "sparse points");
    points_glyph(svg, DVec2::new(x, y));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::densities;
    use crate::testing::{aerial, street};

    #[test]
    fn thin_cells_and_cameras_are_drawn() {
        let mut sparse = street(40, 2000);
        // Every 20th view remains: 40 m apart.
        sparse.points.seen_by.retain(|_| false);
        sparse.points.track_start.clear();
        sparse.views = sparse.views.into_iter().step_by(20).collect();
        let found = densities(&sparse);
        let thin = found[0].thin_cells();
        let svg = draw_density(&found, &sparse);
        // One more in the legend.
        assert!(thin > 0 && svg.matches("class=\"thin-street\"").count() == thin + 1, "{thin}");
        assert!(svg.contains(">2 street views<") && svg.contains("thin<") && svg.trim_end().ends_with("</svg>"));
        let survey = aerial(8, 200.0, 4000);
        let svg = draw_density(&densities(&survey), &survey);
        assert!(svg.contains("aerial camera") && !svg.contains("street camera"));
        assert_eq!(svg.matches("r=\"1.8\"").count(), 64 + 1);
    }
}
