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
    /// Names the file or flag, what is wrong with it, and what to do. Names come out of files too: line ends and other
    /// control characters are escaped, and what is longer than a line is cut.
    pub fn new(subject: impl Into<String>, problem: impl Into<String>, advice: impl Into<String>) -> Self {
        let [subject, problem, advice] = [subject.into(), problem.into(), advice.into()].map(one_line);
        Self { subject, problem, advice }
    }
}

/// Characters of a subject, problem or advice: a path may be as long.
const LINE: usize = 4096;

fn one_line(text: String) -> String {
    if text.len() <= LINE && !text.contains(char::is_control) {
        return text;
    }
    let escaped = text.chars().flat_map(|c| {
        let (plain, escape) = if c.is_control() { (None, Some(c.escape_default())) } else { (Some(c), None) };
        plain.into_iter().chain(escape.into_iter().flatten())
    });
    escaped.take(LINE).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_input_is_one_line_whatever_names_hold() {
        let error = BadInput::new("a\nb\u{1b}[2J.png", "é".repeat(9999), "é");
        assert_eq!(error.subject, "a\\nb\\u{1b}[2J.png");
        assert_eq!((error.problem.chars().count(), error.advice.as_str()), (LINE, "é"));
        assert!(!error.to_string().contains(char::is_control));
    }
}
