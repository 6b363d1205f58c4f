//! What can go wrong with a store, one line each.

use std::error::Error;
use std::io;

use scene::{ArtefactId, BadInput};

/// A store that did not do what was asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// Not the URL of a store.
    #[error(transparent)]
    BadUrl(#[from] BadInput),
    /// A folder that cannot be made or opened.
    #[error("{store}: cannot be made or opened as a folder: {reason}; choose a folder that you may write to")]
    Closed {
        /// The store's URL.
        store: String,
        /// What the file system said.
        reason: String,
    },
    /// No such artefact.
    #[error("artefact {id} is not in the store {store}; run the step that makes it again")]
    Missing {
        /// The artefact.
        id: ArtefactId,
        /// The store's URL.
        store: String,
    },
    /// Bytes that are not those of the id.
    #[error("artefact {id} in the store {store} is damaged; delete it and run the step that makes it again")]
    Corrupt {
        /// The artefact.
        id: ArtefactId,
        /// The store's URL.
        store: String,
    },
    /// A record name that the store does not take.
    #[error(
        "'{0}' is not a name for a record: up to {limit} ASCII letters, digits and ._-/, no part empty or hidden",
        limit = crate::NAME_LIMIT
    )]
    BadName(String),
    /// The place itself failed.
    #[error("cannot {action} {path} in the store {store}: {reason}")]
    Failed {
        /// read, write, create, delete, list, look for
        action: &'static str,
        /// The object's path below the store's URL.
        path: String,
        /// The store's URL.
        store: String,
        /// What the place said, and what to do where that is known.
        reason: String,
    },
}

/// The root of an error in one line; plain words where the operating system's are known.
pub(crate) fn reason(error: &(dyn Error + 'static)) -> String {
    let mut root = error;
    loop {
        if let Some(io) = root.downcast_ref::<io::Error>() {
            match io.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                    return "the disk is full; free some space and run again".into();
                }
                io::ErrorKind::FileTooLarge => {
                    return "the system allows no file as long (ulimit -f); raise that and run again".into();
                }
                io::ErrorKind::ReadOnlyFilesystem => return "the file system is read-only; choose another".into(),
                io::ErrorKind::PermissionDenied => return "permission denied; choose a folder you may write to".into(),
                _ => {}
            }
        }
        match root.source() {
            Some(source) => root = source,
            None => return root.to_string().replace('\n', " "),
        }
    }
}

/// As [`reason`], with plain words for what object servers say.
pub(crate) fn reason_of(error: &object_store::Error) -> String {
    let said = reason(error);
    let whole = error.to_string();
    if whole.contains("NoSuchBucket") {
        return "there is no such bucket; create it, or name another".into();
    }
    match error {
        object_store::Error::PermissionDenied { .. } | object_store::Error::Unauthenticated { .. } => {
            format!(
                "{}; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_REGION, and what they may do",
                short(&said)
            )
        }
        _ => short(&said),
    }
}

/// What a server says may be a page.
fn short(text: &str) -> String {
    const LIMIT: usize = 300;
    if text.chars().count() <= LIMIT { text.into() } else { text.chars().take(LIMIT).chain("...".chars()).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_failures_are_said_in_plain_words() {
        for (kind, words) in [
            (io::ErrorKind::StorageFull, "the disk is full"),
            (io::ErrorKind::FileTooLarge, "the system allows no file as long"),
            (io::ErrorKind::ReadOnlyFilesystem, "read-only"),
            (io::ErrorKind::PermissionDenied, "permission denied"),
        ] {
            let source = Box::new(io::Error::from(kind));
            let error = object_store::Error::Generic { store: "x", source };
            assert!(reason(&error).starts_with(words) || reason(&error).contains(words), "{}", reason(&error));
        }
    }
}
