//! Errors of invalid input: [`CodecError`] for bytes, [`BadInput`] for a named file or flag.

/// An error of a codec. The caller knows the file's name and wraps this in [`BadInput`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct CodecError(pub String);

impl CodecError {
    /// An error with this text: what is wrong, in lower case, without the file's name.
    pub fn new(what: impl Into<String>) -> Self {
        Self(what.into())
    }
}

/// Bad usage or bad input (exit code 2), as one line: file or flag, problem, advice.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{subject}: {problem}; {advice}")]
pub struct BadInput {
    /// The file or flag at fault.
    pub subject: String,
    /// What is wrong with it.
    pub problem: String,
    /// What the user can do about it.
    pub advice: String,
}

impl BadInput {
    /// An error for this file or flag. The texts may contain names from untrusted files, so line breaks and other
    /// control characters are escaped and each text is limited to 4096 characters.
    pub fn new(subject: impl Into<String>, problem: impl Into<String>, advice: impl Into<String>) -> Self {
        let [subject, problem, advice] = [subject.into(), problem.into(), advice.into()].map(one_line);
        Self { subject, problem, advice }
    }
}

/// Largest number of characters of a subject, problem or advice: the length of the longest path.
const MAX_CHARS: usize = 4096;

fn one_line(text: String) -> String {
    if text.len() <= MAX_CHARS && !text.contains(char::is_control) {
        return text;
    }
    let escaped = text.chars().flat_map(|c| {
        let (plain, escape) = if c.is_control() { (None, Some(c.escape_default())) } else { (Some(c), None) };
        plain.into_iter().chain(escape.into_iter().flatten())
    });
    escaped.take(MAX_CHARS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_input_is_one_line_for_any_name() {
        let error = BadInput::new("a\nb\u{1b}[2J.png", "é".repeat(9999), "é");
        assert_eq!(error.subject, "a\\nb\\u{1b}[2J.png");
        assert_eq!((error.problem.chars().count(), error.advice.as_str()), (MAX_CHARS, "é"));
        assert!(!error.to_string().contains(char::is_control));
    }
}
