//! Paths of objects from above, as SVG.

use std::fmt::Write;

use glam::{DQuat, DVec2, DVec3};
use scene::{MovingObject, View};

/// Width of the picture without its margin, pixels.
const WIDTH: f64 = 1200.0;
const MARGIN: f64 = 40.0;
/// The longest side of the ground that is drawn around the cameras, metres.
const REACH_METRES: f64 = 60.0;
/// Distance of the marks on a path, seconds.
const MARK_SECONDS: f64 = 1.0;

/// Draws found paths, the true ones where they are known, and where the photos were taken.
pub(crate) fn draw(
    views: &[View],
    (found, truth): (&[MovingObject], Option<&[MovingObject]>),
    ground_from_world: DQuat,
) -> String {
    let on_ground = |place: DVec3| (ground_from_world * place).truncate();
    let cameras: Vec<DVec2> = views.iter().map(|view| on_ground(view.camera.centre())).collect();
    let place = |object: &MovingObject, seconds: f64| {
        Some(on_ground(object.pose(seconds)?.apply(0.5 * (object.low + object.high))))
    };
    let times: Vec<f64> = views.iter().filter_map(|view| view.seconds).collect();
    let [from, to] =
        [f64::min as fn(f64, f64) -> f64, f64::max].map(|pick| times.iter().copied().reduce(pick).unwrap_or_default());
    let path = |object: &MovingObject| -> Vec<(f64, DVec2)> {
        let at = object.path.iter().filter(|pose| (from..=to).contains(&pose.seconds));
        at.filter_map(|pose| Some((pose.seconds, place(object, pose.seconds)?))).collect()
    };
    let (low, high) =
        cameras.iter().fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), at| (low.min(*at), high.max(*at)));
    let (low, high) = (low - REACH_METRES, high + REACH_METRES);
    let scale = WIDTH / (high - low).max_element().max(1.0);
    let pixel = |at: DVec2| DVec2::new(MARGIN + (at.x - low.x) * scale, MARGIN + (high.y - at.y) * scale);
    let size = (high - low) * scale + 2.0 * MARGIN;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {:.0} {:.0}\" font-family=\"sans-serif\" font-size=\"14\">\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>",
        size.x, size.y
    );
    let mut line = |points: &[(f64, DVec2)], colour: &str, width: f64, marks: bool| {
        let inside: Vec<&(f64, DVec2)> =
            points.iter().filter(|(_, at)| at.cmpge(low).all() && at.cmple(high).all()).collect();
        let text: Vec<String> =
            inside.iter().map(|(_, at)| pixel(*at)).map(|at| format!("{:.1},{:.1}", at.x, at.y)).collect();
        let _ = write!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>",
            text.join(" ")
        );
        let mut last = f64::NEG_INFINITY;
        for (seconds, at) in inside.into_iter().filter(|_| marks) {
            if seconds - last >= MARK_SECONDS {
                last = *seconds;
                let at = pixel(*at);
                let _ = write!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3\" fill=\"{colour}\"/>", at.x, at.y);
            }
        }
    };
    truth.unwrap_or_default().iter().for_each(|object| line(&path(object), "#c4c4c4", 6.0, false));
    for object in found {
        let colour = if object.class == "person" { "#b8336a" } else { "#1f5fae" };
        line(&path(object), colour, 2.0, true);
    }
    for at in cameras.iter().map(|at| pixel(*at)) {
        let _ = write!(svg, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"1\" fill=\"#777777\"/>", at.x, at.y);
    }
    let (bar, bottom) = (10.0 * scale, size.y - 14.0);
    let _ = writeln!(
        svg,
        "<path d=\"M{MARGIN},{bottom:.1} h{bar:.1}\" stroke=\"#222222\" stroke-width=\"2\"/>\
         <text x=\"{:.1}\" y=\"{:.1}\" fill=\"#222222\">10 m · vehicles blue, people red, a dot a second · true paths grey, wide · photos small grey dots</text></svg>",
        MARGIN + bar + 10.0,
        bottom + 5.0
    );
    svg
}

#[cfg(test)]
mod tests {
    use scene::{Camera, PathPose, Pinhole, Rigid};

    use super::*;

    #[test]
    fn paths_are_drawn_where_they_are() {
        let pinhole = Pinhole { width: 4, height: 4, fx: 2.0, fy: 2.0, cx: 2.0, cy: 2.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid::IDENTITY };
        let view = |seconds: f64| View {
            name: "a".into(),
            camera,
            mips: Vec::new(),
            masked: false,
            depth: None,
            seconds: Some(seconds),
        };
        let pose = |seconds: f64| PathPose {
            seconds,
            world_from_object: Rigid { translation: DVec3::new(10.0 * seconds, 0.0, 0.0), ..Rigid::IDENTITY },
        };
        let car = MovingObject {
            id: "a".into(),
            class: "car".into(),
            low: DVec3::splat(-1.0),
            high: DVec3::splat(1.0),
            path: vec![pose(0.0), pose(1.0), pose(9.0)],
        };
        let svg = draw(&[view(0.0), view(2.0)], (&[car], None), DQuat::IDENTITY);
        // Ten metres of 120 are 100 pixels; what is after the last photo is left out.
        assert!(svg.contains("<polyline points=\"640.0,640.0 740.0,640.0\""), "{svg}");
        assert!(svg.ends_with("</svg>\n") && !svg.contains("NaN"));
        assert!(draw(&[], (&[], None), DQuat::IDENTITY).ends_with("</svg>\n"));
    }
}
