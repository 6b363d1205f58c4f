//! Kinds of objects that move by themselves.

use glam::DVec3;

/// A kind of object that moves by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Who walks.
    Person,
    /// With its rider.
    Bicycle,
    /// With its rider.
    Motorcycle,
    /// Vans too.
    Car,
    /// Lorries too.
    Truck,
    /// Coaches too.
    Bus,
}

impl Kind {
    /// The kind of a class of COCO, Cityscapes, KITTI, nuScenes, Waymo or DGP; `None` if it does not move by itself.
    pub fn of_class(class: &str) -> Option<Self> {
        let class = class.to_lowercase();
        if class.starts_with("static") {
            return None;
        }
        let mut words = class.split(|c: char| !c.is_alphabetic());
        words.find_map(|word| match word {
            "person" | "pedestrian" | "pedestrians" => Some(Self::Person),
            "bicycle" | "cyclist" | "rider" => Some(Self::Bicycle),
            "motorcycle" | "motorcyclist" | "motorbike" => Some(Self::Motorcycle),
            "car" | "van" => Some(Self::Car),
            "truck" | "lorry" => Some(Self::Truck),
            "bus" | "coach" => Some(Self::Bus),
            _ => None,
        })
    }

    /// The name of COCO.
    pub fn name(self) -> &'static str {
        match self {
            Self::Person => "person",
            Self::Bicycle => "bicycle",
            Self::Motorcycle => "motorcycle",
            Self::Car => "car",
            Self::Truck => "truck",
            Self::Bus => "bus",
        }
    }

    /// Usual length, width and height, metres.
    pub(crate) fn size(self) -> DVec3 {
        match self {
            Self::Person => DVec3::new(0.6, 0.6, 1.7),
            Self::Bicycle => DVec3::new(1.8, 0.6, 1.7),
            Self::Motorcycle => DVec3::new(2.1, 0.8, 1.6),
            Self::Car => DVec3::new(4.3, 1.8, 1.5),
            Self::Truck => DVec3::new(7.0, 2.4, 3.0),
            Self::Bus => DVec3::new(11.0, 2.5, 3.2),
        }
    }

    /// No such object in a town is faster, metres per second.
    pub(crate) fn max_speed(self) -> f64 {
        match self {
            Self::Person => 4.0,
            Self::Bicycle => 14.0,
            _ => 40.0,
        }
    }

    /// Whether it is one person or a cycle: less than a metre wide.
    pub(crate) fn is_narrow(self) -> bool {
        self <= Self::Motorcycle
    }
}

/// Whether two sightings may be of one object: a van may be taken for a lorry, but not for a person.
pub(crate) fn may_be_same(a: Option<Kind>, b: Option<Kind>) -> bool {
    a.zip(b).is_none_or(|(a, b)| a.is_narrow() == b.is_narrow())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_sets_name_kinds_differently() {
        let kinds = ["car", "Pedestrian", "vehicle.bus.rigid", "Bus/RV/Caravan", "human.pedestrian.adult", "Truck"];
        use Kind::{Bus, Car, Person, Truck};
        assert_eq!(kinds.map(Kind::of_class), [Car, Person, Bus, Bus, Person, Truck].map(Some));
        assert_eq!(["traffic light", "carrot", "", "static_object.bicycle_rack"].map(Kind::of_class), [None; 4]);
        for kind in kinds.into_iter().filter_map(Kind::of_class) {
            assert_eq!(Kind::of_class(kind.name()), Some(kind));
        }
    }
}
