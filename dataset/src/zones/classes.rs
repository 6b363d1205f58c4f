//! Which ids of label maps are objects.

use std::collections::BTreeMap;
use std::path::Path;

use scene::BadInput;

/// From this id on an id is that of a single object: this times its class, and its number (Cityscapes' `instanceIds`).
const INSTANCE: u32 = 1000;
/// The classes of Cityscapes that have instances.
const CITYSCAPES: [(u32, &str); 10] = [
    (24, "person"),
    (25, "rider"),
    (26, "car"),
    (27, "truck"),
    (28, "bus"),
    (29, "caravan"),
    (30, "trailer"),
    (31, "train"),
    (32, "motorcycle"),
    (33, "bicycle"),
];

/// The classes of objects, in the order of their ids.
#[derive(Debug, PartialEq)]
pub(super) struct Classes(Vec<(u32, String)>);

impl Default for Classes {
    /// Those of Cityscapes.
    fn default() -> Self {
        Self(CITYSCAPES.iter().map(|(id, name)| (*id, (*name).to_owned())).collect())
    }
}

impl Classes {
    /// Reads a JSON object of names by id, `{"26": "car"}`, or lines `ID NAME`; the file's extension decides.
    ///
    /// # Errors
    /// Neither of them, no class, or too many.
    pub(super) fn read(path: &Path, text: &str) -> Result<Self, BadInput> {
        let bad = |problem: String| {
            let advice = "list the ids that are objects: lines ID NAME, or as JSON {\"26\": \"car\"}";
            BadInput::new(path.display().to_string(), problem, advice)
        };
        let entries: Vec<(String, String)> = if path.extension().is_some_and(|end| end == "json") {
            let names: BTreeMap<String, String> =
                serde_json::from_str(text).map_err(|error| bad(format!("has no names by id ({error})")))?;
            names.into_iter().collect()
        } else {
            let lines = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
            let parts = lines.map(|line| line.split_once(char::is_whitespace).unwrap_or((line, "")));
            parts.map(|(id, name)| (id.to_owned(), name.trim().to_owned())).collect()
        };
        let mut classes = BTreeMap::new();
        for (id, name) in entries {
            let number: u32 = id.parse().map_err(|_| bad(format!("has the id {id:?}, which is no number")))?;
            let name = if name.is_empty() { format!("class {number}") } else { name };
            classes.insert(number, name);
        }
        if classes.is_empty() || classes.len() > usize::from(u16::MAX) {
            return Err(bad(format!("names {} classes, and 1 to {} are possible", classes.len(), u16::MAX)));
        }
        Ok(Self(classes.into_iter().collect()))
    }

    /// The id of the class that an id of a pixel belongs to, if that is an object.
    pub(super) fn class_of(&self, id: u32) -> Option<u16> {
        let class = if id < INSTANCE { id } else { id / INSTANCE };
        self.0.binary_search_by_key(&class, |(id, _)| *id).ok().map(|place| place as u16)
    }

    /// The names, in the order of the ids.
    pub(super) fn names(&self) -> Vec<String> {
        self.0.iter().map(|(_, name)| name.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_have_the_class_of_their_thousands() {
        let classes = Classes::default();
        let names = classes.names();
        let name = |id| classes.class_of(id).map(|class| names[usize::from(class)].as_str());
        assert_eq!(
            [name(26_003), name(26), name(24_000), name(33_999)],
            [Some("car"), Some("car"), Some("person"), Some("bicycle")]
        );
        assert_eq!([name(0), name(7), name(7_001), name(255), name(34_000), name(u32::MAX)], [None; 6]);
    }

    #[test]
    fn classes_come_from_json_or_lines() {
        let read = |name: &str, text: &str| Classes::read(Path::new(name), text);
        let expected = Classes(vec![(0, "kerb stone".into()), (13, "car".into())]);
        assert_eq!(read("classes.json", r#"{"13": "car", "0": "kerb stone"}"#).unwrap(), expected);
        assert_eq!(read("classes.txt", "# mine\n13 car\n\n 0\tkerb stone \n").unwrap(), expected);
        assert_eq!(read("classes.txt", "5").unwrap().names(), ["class 5"]);
        for (name, text, says) in [
            ("classes.json", "[1]", "no names by id"),
            ("classes.json", "{}", "names 0 classes"),
            ("classes.txt", "car 13", "\"car\""),
            ("classes.txt", "-1 car", "\"-1\""),
        ] {
            let line = read(name, text).unwrap_err().to_string();
            assert!(line.contains(says) && line.starts_with(name), "{line}");
        }
    }
}
