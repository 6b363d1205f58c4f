//! The two ways in which input can be wrong: bytes without a name, and a named thing.

/// What a codec says of bytes it cannot accept. The caller knows the file's name and wraps this in [`BadInput`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct CodecError(pub String);

impl CodecError {
    /// An error with this text: what is wrong, in lower case, without a file name.
    pub fn new(what: impl Into<String>) -> Self {
        Self(what.into())
    }
}

/// Bad usage or bad input: exit code 2. One line: which file or flag, what is wrong, what to do.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{subject}: {problem}; {advice}")]
pub struct BadInput {
    /// The file or flag at fault.
    pub subject: String,
    /// What is wrong with it.
    pub problem: String,
    /// What the person can do about it.
    pub advice: String,
}

impl BadInput {
    /// Names the file or flag, what is wrong with it, and what to do.
    pub fn new(subject: impl Into<String>, problem: impl Into<String>, advice: impl Into<String>) -> Self {
        Self { subject: subject.into(), problem: problem.into(), advice: advice.into() }
    }
}
