//! Errors of a store, one line each, and the reasons given in them.

use std::error::Error;
use std::io;

use scene::{ArtefactId, BadInput};

use crate::paths::MAX_RECORD_NAME_BYTES;

/// A store operation that failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// Not the URL of a store.
    #[error(transparent)]
    BadUrl(#[from] BadInput),
    /// A folder that cannot be created or opened, or a network runtime that does not start.
    #[error("{store}: cannot be made or opened as a folder: {reason}; choose a folder that you may write to")]
    CannotOpen {
        /// The store's URL.
        store: String,
        /// The file system's reason.
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
    /// Bytes that do not have the hash or the length of the artefact.
    #[error("artefact {id} in the store {store} is damaged; delete it and run the step that makes it again")]
    Corrupt {
        /// The artefact.
        id: ArtefactId,
        /// The store's URL.
        store: String,
    },
    /// An invalid record name.
    #[error(
        "'{0}' is not a name for a record: up to {limit} ASCII letters, digits and ._-/, no part empty or hidden",
        limit = MAX_RECORD_NAME_BYTES
    )]
    BadRecordName(String),
    /// The underlying object store failed.
    #[error("cannot {action} {path} in the store {store}: {reason}")]
    Failed {
        /// read, write, create, delete, list, look for
        action: &'static str,
        /// The object's path below the store's URL.
        path: String,
        /// The store's URL.
        store: String,
        /// The object store's reason, with advice where there is any.
        reason: String,
    },
}

/// The root cause of an error in one line, with advice for the operating system's common failures.
pub(crate) fn reason(error: &(dyn Error + 'static)) -> String {
    let mut root = error;
    loop {
        if let Some(io) = root.downcast_ref::<io::Error>() {
            match io.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                    return "the disk is full; free some space and run again".into();
                }
                io::ErrorKind::FileTooLarge => {
                    return "the file exceeds the system's size limit (ulimit -f); raise the limit and run again"
                        .into();
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

/// As [`reason`], with advice for the common failures of object servers.
pub(crate) fn object_store_reason(error: &object_store::Error) -> String {
    let root = reason(error);
    if error.to_string().contains("NoSuchBucket") {
        return "there is no such bucket; create it, or name another".into();
    }
    match error {
        object_store::Error::PermissionDenied { .. } | object_store::Error::Unauthenticated { .. } => {
            format!(
                "{}; check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_REGION, and what they may do",
                truncated(&root)
            )
        }
        _ => truncated(&root),
    }
}

/// Servers may answer with a whole HTML page.
fn truncated(text: &str) -> String {
    const MAX_CHARS: usize = 300;
    if text.chars().count() <= MAX_CHARS {
        text.into()
    } else {
        text.chars().take(MAX_CHARS).chain("...".chars()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn common_io_errors_have_advice() {
        for (kind, words) in [
            (io::ErrorKind::StorageFull, "the disk is full"),
            (io::ErrorKind::FileTooLarge, "the file exceeds the system's size limit"),
            (io::ErrorKind::ReadOnlyFilesystem, "read-only"),
            (io::ErrorKind::PermissionDenied, "permission denied"),
        ] {
            let source = Box::new(io::Error::from(kind));
            let error = object_store::Error::Generic { store: "x", source };
            assert!(reason(&error).contains(words), "{}", reason(&error));
        }
    }
}
