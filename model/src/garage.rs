//! A garage: vehicles in their own axes, to be placed in any model (EDeRF, section 3.1 and 3.2).
//!
//! ```text
//! DIR/garage.json     the vehicles; written last, so that one that is not named there is not in it
//! DIR/NAME.ply        splats of each, in its own axes (x ahead, y left, z up), metres
//! DIR/NAME.swing      how those of a person swing, as a frame
//! ```

use std::path::{Path, PathBuf};

use glam::{DMat4, DVec3};
use scene::objects::is_name;
use scene::similarity::Similarity;
use scene::{BadInput, MovingObject, PathPose, Rigid, Splats, Swing, ply};
use serde::{Deserialize, Serialize};
use store::file::save;

use crate::error::{ModelError, cannot};
use crate::files::{damaged, load, save_json};
use crate::read::read_swing;
use crate::write::{save_objects, save_swing};
use crate::{ModelObject, ply_comments, read};

const FILE: &str = "garage.json";
const VERSION: u32 = 1;
/// The maximum size of `garage.json`, bytes.
const MAX_BYTES: u64 = 1 << 24;

/// A vehicle of a garage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Vehicle {
    /// Letters, digits, `-` and `_`.
    pub name: String,
    /// As where it comes from.
    pub class: String,
    /// The lower corner of its box in its own axes, metres.
    pub low: DVec3,
    /// The upper corner.
    pub high: DVec3,
    /// Whether its splats are drawn with opacity compensation.
    pub antialiased: bool,
    /// Number of its splats.
    pub splats: usize,
}

impl Vehicle {
    /// It as an object that moves along a path.
    pub fn on(&self, path: Vec<PathPose>, id: &str) -> MovingObject {
        MovingObject { id: id.to_owned(), class: self.class.clone(), low: self.low, high: self.high, path }
    }

    /// Checks what other functions rely on: every number of a file is untrusted.
    fn check(&self) -> Result<(), scene::CodecError> {
        let still = PathPose { seconds: 0.0, world_from_object: Rigid::IDENTITY };
        self.on(vec![still], &self.name).check()
    }
}

#[derive(Serialize, Deserialize)]
struct File {
    version: u32,
    vehicles: Vec<Vehicle>,
}

/// The vehicles in a folder.
pub struct Garage {
    folder: PathBuf,
    vehicles: Vec<Vehicle>,
}

impl Garage {
    /// The garage in a folder; an empty one if there is none.
    ///
    /// # Errors
    /// A `garage.json` that cannot be read, or vehicles that are wrong.
    pub fn open(folder: &Path) -> Result<Self, BadInput> {
        let path = folder.join(FILE);
        if !path.exists() {
            return Ok(Self { folder: folder.into(), vehicles: Vec::new() });
        }
        let bad =
            |problem: String| BadInput::new(path.display().to_string(), problem, "restore it, or use another garage");
        if path.metadata().is_ok_and(|file| file.len() > MAX_BYTES) {
            return Err(bad(format!("is larger than {} MB", MAX_BYTES >> 20)));
        }
        let file: File = serde_json::from_slice(&load(&path)?).map_err(|error| bad(error.to_string()))?;
        if file.version != VERSION {
            return Err(bad(format!("has version {}, and {VERSION} is known", file.version)));
        }
        file.vehicles.iter().try_for_each(Vehicle::check).map_err(|error| bad(error.to_string()))?;
        Ok(Self { folder: folder.into(), vehicles: file.vehicles })
    }

    /// Its vehicles, by name.
    pub fn vehicles(&self) -> &[Vehicle] {
        &self.vehicles
    }

    /// A vehicle with its splats.
    ///
    /// # Errors
    /// A name that it does not have, or a file that cannot be read.
    pub fn get(&self, name: &str) -> Result<(Vehicle, Splats, Option<Swing>), BadInput> {
        let Some(vehicle) = self.vehicles.iter().find(|vehicle| vehicle.name == name) else {
            let names: Vec<&str> = self.vehicles.iter().map(|vehicle| vehicle.name.as_str()).collect();
            let has = if names.is_empty() { "none".into() } else { names.join(", ") };
            let problem = format!("has no vehicle '{name:.64}', it has {has}");
            return Err(BadInput::new(self.folder.display().to_string(), problem, "give one of its vehicles"));
        };
        let path = self.folder.join(format!("{name}.ply"));
        let splats = ply::read(&load(&path)?).map_err(|error| damaged(&path, &error))?;
        let swing = read_swing(&self.folder, name, splats.len())?;
        Ok((vehicle.clone(), splats, swing))
    }

    /// Checks that a vehicle of this name can be added.
    ///
    /// # Errors
    /// A name that is taken or no name.
    pub fn check_name(&self, name: &str) -> Result<(), BadInput> {
        if !is_name(name) {
            return Err(bad_vehicle(name, "is no name", "use letters, digits, - and _"));
        }
        match self.vehicles.iter().any(|other| other.name == name) {
            true => Err(bad_vehicle(name, "is in the garage already", "give another --name")),
            false => Ok(()),
        }
    }

    /// Adds a vehicle.
    ///
    /// # Errors
    /// A name that is taken or no name, a box that is wrong, no splats, a file that cannot be written.
    pub fn add(&mut self, vehicle: Vehicle, splats: &Splats, swing: Option<&Swing>) -> Result<(), ModelError> {
        self.check_name(&vehicle.name)?;
        let bad = |problem: &str, advice: &str| bad_vehicle(&vehicle.name, problem, advice);
        vehicle.check().map_err(|error| bad(&error.to_string(), "correct the box"))?;
        if splats.is_empty() {
            return Err(bad("would have no splats", "check that the box is where the model shows it").into());
        }
        std::fs::create_dir_all(&self.folder).map_err(cannot("made", &self.folder))?;
        let path = self.folder.join(format!("{}.ply", vehicle.name));
        save(&path, &ply::write(splats, ply_comments(vehicle.antialiased)))?;
        save_swing(&self.folder, &vehicle.name, swing)?;
        let at = self.vehicles.partition_point(|other| other.name < vehicle.name);
        self.vehicles.insert(at, Vehicle { splats: splats.len(), ..vehicle });
        Ok(save_json(&self.folder.join(FILE), &File { version: VERSION, vehicles: self.vehicles.clone() })?)
    }
}

fn bad_vehicle(name: &str, problem: &str, advice: &str) -> BadInput {
    BadInput::new(format!("vehicle '{name:.64}'"), problem, advice.to_owned())
}

/// The splats in a box of the world, in the axes of the box, whose origin `world_from_box` moves.
pub fn cut_out(splats: &Splats, world_from_box: &Rigid, low: DVec3, high: DVec3) -> Splats {
    let box_from_world = world_from_box.inverse();
    let is_inside = |i: usize| {
        let place = box_from_world.apply(splats.mean(i).as_dvec3());
        place.cmpge(low).all() && place.cmple(high).all()
    };
    let mut inside = splats.filter(|i| splats.is_finite(i) && is_inside(i));
    let matrix = DMat4::from_rotation_translation(box_from_world.rotation, box_from_world.translation);
    if let Some(similarity) = Similarity::from_matrix(matrix) {
        similarity.apply(&mut inside);
    }
    inside
}

/// Places an object in a model that `plat train` wrote: adds it to its `objects` folder, and changes nothing else.
///
/// # Errors
/// A model that is a file, an object that is wrong or of a name that the model has, splats that are drawn differently, a file that
/// cannot be written.
pub fn place(path: &Path, object: ModelObject, antialiased: bool) -> Result<(), ModelError> {
    let bad = |problem: String, advice: &str| BadInput::new(path.display().to_string(), problem, advice.to_owned());
    let model = read(path)?;
    let Some((_, out)) = &model.trained else {
        return Err(bad("is one file, which has no objects".into(), "give a folder that plat train wrote").into());
    };
    if model.antialiased != antialiased {
        let problem = "is drawn with another filter than the vehicle was trained with";
        return Err(bad(problem.into(), "give a vehicle of a model of the same kind").into());
    }
    let id = &object.about.id;
    if model.objects.iter().any(|other| other.about.id == *id) {
        return Err(bad(format!("has an object '{id}' already"), "give another --id").into());
    }
    object.about.check().map_err(|error| bad(error.to_string(), "correct the path"))?;
    let mut objects = model.objects;
    let at = objects.partition_point(|other| other.about.id < *id);
    objects.insert(at, object);
    save_objects(out, &objects, antialiased)
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, Vec3};
    use scene::Splat;

    use super::*;

    fn car(name: &str) -> Vehicle {
        let (low, high) = (DVec3::new(-2.0, -1.0, 0.0), DVec3::new(2.0, 1.0, 1.5));
        Vehicle { name: name.into(), class: "car".into(), low, high, antialiased: true, splats: 0 }
    }

    #[test]
    fn what_a_box_holds_is_cut_out_in_its_axes() {
        let world_from_box = Rigid { rotation: DQuat::from_rotation_z(0.5), translation: DVec3::new(10.0, 5.0, 1.0) };
        let mut splats = Splats::new(1);
        let own = [Vec3::new(1.5, 0.5, 0.2), Vec3::new(-1.9, -0.9, 1.4)];
        let beside = [Vec3::new(2.5, 0.0, 0.5), Vec3::new(0.0, 0.0, -0.2)];
        for place in own.iter().chain(&beside) {
            let world = world_from_box.apply(place.as_dvec3()).as_vec3();
            splats.push(&Splat::round(world, -2.0, Vec3::splat(0.5), 0.7));
        }
        splats.push(&Splat::round(Vec3::NAN, -2.0, Vec3::splat(0.5), 0.7));
        let cut = cut_out(&splats, &world_from_box, car("a").low, car("a").high);
        assert_eq!(cut.len(), 2);
        for (i, place) in own.iter().enumerate() {
            assert!((cut.mean(i) - *place).length() < 1e-5, "{}", cut.mean(i));
        }
    }

    #[test]
    fn a_garage_keeps_vehicles_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().join("garage");
        let mut garage = Garage::open(&at).unwrap();
        assert!(garage.vehicles().is_empty() && garage.get("a").is_err());
        let mut splats = Splats::new(0);
        splats.push(&Splat::round(Vec3::ZERO, -2.0, Vec3::splat(0.5), 0.7));
        // A vehicle that swings, whose addition was cut short: one of its name does not swing by it.
        std::fs::create_dir_all(&at).unwrap();
        let swing = Swing { stride_metres: 1.4, amplitudes: vec![[0.1; scene::swing::NUMBERS]] };
        save_swing(&at, "van", Some(&swing)).unwrap();
        for name in ["van", "car"] {
            garage.add(car(name), &splats, None).unwrap();
        }
        assert_eq!(garage.get("van").unwrap().2, None);
        garage.add(car("walker"), &splats, Some(&swing)).unwrap();
        assert_eq!(garage.get("walker").unwrap().2, Some(swing));
        let names = |garage: &Garage| garage.vehicles().iter().map(|of| of.name.clone()).collect::<Vec<_>>();
        assert_eq!(names(&garage), ["car", "van", "walker"]);
        let garage = Garage::open(&at).unwrap();
        assert_eq!((names(&garage), garage.get("car").unwrap().0.splats), (names(&garage), 1));
        assert!(garage.get("van").unwrap().1 == splats);

        let mut garage = garage;
        for (vehicle, splats, says) in [
            (car("car"), &splats, "already"),
            (car("../x"), &splats, "no name"),
            (car("empty"), &Splats::new(0), "no splats"),
            (Vehicle { high: DVec3::ZERO, ..car("flat") }, &splats, "no size"),
        ] {
            let error = garage.add(vehicle, splats, None).unwrap_err().to_string();
            assert!(error.contains(says) && !error.contains('\n'), "{error}");
        }
        let file = at.join(FILE);
        let text = std::fs::read_to_string(&file).unwrap();
        for (from, to, says) in [
            ("\"version\": 1", "\"version\": 2", "version 2"),
            ("\"car\"", "\"../car\"", "name"),
            ("1.5", "1e400", "garage.json"),
            ("1.5", "-1.5", "no size"),
            ("{", "", "garage.json"),
        ] {
            assert!(text.contains(from));
            std::fs::write(&file, text.replacen(from, to, 1)).unwrap();
            let error = Garage::open(&at).err().unwrap().to_string();
            assert!(error.contains(says) && !error.contains('\n'), "{error}");
        }
    }
}
