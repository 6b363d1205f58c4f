//! `tracklet_labels.xml`: the boxes of vehicles and people that a camera sees or the lidar hit, in the axes of the Velodyne.

use std::collections::BTreeMap;
use std::fmt::Write;

use city::Class;
use city::trace::{World, motion};
use glam::{DVec3, EulerRot};
use rayon::prelude::*;
use scene::Rigid;

use super::super::nuscenes::{Object, Sample, around};
use super::super::tracks_and_boxes::bounds_at_all_times;

/// A frame of a drive.
pub(super) struct Frame<'a> {
    pub(super) sample: Sample<'a>,
    pub(super) world_from_velodyne: Rigid,
}

/// An object in consecutive frames.
struct Tracklet {
    actor: usize,
    first_frame: usize,
    /// Translation and angles about x, y and z of each frame.
    poses: Vec<[f64; 6]>,
}

/// The text of the file. `frames` are in order; an object that is not there for a while is another one afterwards, as the format has
/// no gaps.
pub(super) fn text(world: &World, frames: &[Frame]) -> String {
    let city = world.city();
    let seen: Vec<Vec<Object>> = frames.par_iter().map(|frame| around(world, &frame.sample)).collect();
    let mut tracklets: Vec<Tracklet> = Vec::new();
    // The tracklet of an actor that may go on.
    let mut open: BTreeMap<usize, usize> = BTreeMap::new();
    for (Frame { sample, world_from_velodyne }, objects) in frames.iter().zip(&seen) {
        let (frame, seconds) = (sample.station.frame, sample.station.seconds);
        for object in objects {
            let actor = &city.actors[object.actor];
            let Some((low, high)) = bounds_at_all_times(city, actor) else { continue };
            let middle = 0.5 * (low + high).as_dvec3();
            let pose = world_from_velodyne.inverse().compose(&motion::pose_at(actor, seconds));
            let place = pose.apply(DVec3::new(middle.x, middle.y, f64::from(low.z)));
            let (rz, ry, rx) = pose.rotation.to_euler(EulerRot::ZYX);
            let next = open.get(&object.actor).copied().filter(|&at| {
                let of: &Tracklet = &tracklets[at];
                of.first_frame + of.poses.len() == frame
            });
            let at = next.unwrap_or_else(|| {
                tracklets.push(Tracklet { actor: object.actor, first_frame: frame, poses: Vec::new() });
                tracklets.len() - 1
            });
            tracklets[at].poses.push([place.x, place.y, place.z, rx, ry, rz]);
            open.insert(object.actor, at);
        }
    }
    let mut text = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\" ?>\n<!DOCTYPE boost_serialization>\n\
         <boost_serialization signature=\"serialization::archive\" version=\"9\">\n\
         <tracklets class_id=\"0\" tracking_level=\"0\" version=\"0\">\n\t<count>{}</count>\n\t<item_version>1</item_version>\n",
        tracklets.len()
    );
    for (number, tracklet) in tracklets.iter().enumerate() {
        let actor = &city.actors[tracklet.actor];
        let size = bounds_at_all_times(city, actor).map_or(DVec3::ZERO, |(low, high)| (high - low).as_dvec3());
        // Boost describes a class where it occurs first.
        let attributes = |level: u32, version: u32, is_first: bool| match is_first {
            true => format!(" class_id=\"{level}\" tracking_level=\"0\" version=\"{version}\""),
            false => String::new(),
        };
        let mut write = |line: std::fmt::Arguments| text.write_fmt(line).expect("writing to a string cannot fail");
        write(format_args!(
            "\t<item{}>\n\t\t<objectType>{}</objectType>\n\t\t<h>{}</h>\n\t\t<w>{}</w>\n\t\t<l>{}</l>\n\
             \t\t<first_frame>{}</first_frame>\n\t\t<poses{}>\n\t\t\t<count>{}</count>\n\t\t\t<item_version>2</item_version>\n",
            attributes(1, 1, number == 0),
            class(actor.class),
            size.z,
            size.y,
            size.x,
            tracklet.first_frame,
            attributes(2, 0, number == 0),
            tracklet.poses.len()
        ));
        for (i, [tx, ty, tz, rx, ry, rz]) in tracklet.poses.iter().enumerate() {
            write(format_args!(
                "\t\t\t<item{}>\n\t\t\t\t<tx>{tx}</tx><ty>{ty}</ty><tz>{tz}</tz><rx>{rx}</rx><ry>{ry}</ry><rz>{rz}</rz>\n\
                 \t\t\t\t<state>2</state><occlusion>-1</occlusion><occlusion_kf>-1</occlusion_kf><truncation>-1</truncation>\n\
                 \t\t\t\t<amt_occlusion>-1</amt_occlusion><amt_occlusion_kf>-1</amt_occlusion_kf><amt_border_l>-1</amt_border_l>\
                 <amt_border_r>-1</amt_border_r><amt_border_kf>-1</amt_border_kf>\n\t\t\t</item>\n",
                attributes(3, 2, number == 0 && i == 0)
            ));
        }
        write(format_args!("\t\t</poses>\n\t\t<finished>1</finished>\n\t</item>\n"));
    }
    text += "</tracklets>\n</boost_serialization>\n";
    text
}

/// What KITTI calls a class.
fn class(class: Class) -> &'static str {
    match class {
        Class::Person | Class::Rider => "Pedestrian",
        Class::Bicycle => "Cyclist",
        Class::Car => "Car",
        Class::Truck => "Truck",
        _ => "Misc",
    }
}
