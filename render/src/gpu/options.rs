//! Options for opening a GPU, and the environment variables that set them.

use super::error::GpuError;

/// Options for opening a GPU. Only `path` affects results; it is part of the backend's name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// Substring of the adapter's name, case-insensitive; `None`: the most powerful adapter.
    pub adapter: Option<String>,
    /// Cap of the total buffer size, bytes; `None`: unlimited.
    pub memory_bytes: Option<u64>,
    /// The variant of the stages.
    pub path: Path,
}

/// The variant of the stages. Results are bit-identical only within one path.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Path {
    /// The stages without subgroup operations, which every adapter runs.
    Portable,
    /// The subgroup stages if the adapter has subgroups of one fixed size, else the portable ones.
    #[default]
    Fast,
    /// The subgroup stages with per-pixel gradient terms in half precision: less workgroup memory traffic, gradients
    /// correct to three digits. Opening fails on an adapter without subgroups of one size or without halves.
    Half,
}

impl GpuOptions {
    /// Reads `PLAT_GPU_ADAPTER`, `PLAT_GPU_MEMORY` (a number of bytes, KiB, MiB or GiB) and `PLAT_GPU_PATH` (`fast`,
    /// `portable` or `half`). Unset or empty variables give the default.
    ///
    /// # Errors
    /// An invalid value.
    pub fn from_env() -> Result<Self, GpuError> {
        let var = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        Self::parse(var("PLAT_GPU_ADAPTER"), var("PLAT_GPU_MEMORY"), var("PLAT_GPU_PATH"))
    }

    fn parse(adapter: Option<String>, memory: Option<String>, path: Option<String>) -> Result<Self, GpuError> {
        let invalid = |name, value: String, wanted| {
            Err(GpuError::Setting { name, value: super::error::one_line(&value), wanted })
        };
        let memory_bytes = match memory {
            Some(text) => match parse_bytes(&text) {
                Some(bytes) => Some(bytes),
                None => return invalid("PLAT_GPU_MEMORY", text, "a size such as 512MiB or 20GiB"),
            },
            None => None,
        };
        let path = match path.as_deref() {
            None | Some("fast") => Path::Fast,
            Some("portable") => Path::Portable,
            Some("half") => Path::Half,
            Some(other) => return invalid("PLAT_GPU_PATH", other.into(), "fast, portable or half"),
        };
        Ok(Self { adapter, memory_bytes, path })
    }
}

/// Parses a size such as "1500", "512 KiB" or "20GiB".
fn parse_bytes(text: &str) -> Option<u64> {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let unit: u64 = match text[end..].trim() {
        "" | "B" => 1,
        "KiB" => 1 << 10,
        "MiB" => 1 << 20,
        "GiB" => 1 << 30,
        _ => return None,
    };
    text[..end].parse::<u64>().ok()?.checked_mul(unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_values_are_parsed_and_others_are_rejected() {
        let parse = |memory: Option<&str>, path: Option<&str>| {
            GpuOptions::parse(Some("lava".into()), memory.map(Into::into), path.map(Into::into))
        };
        let default = parse(None, None).expect("no value is invalid");
        assert_eq!(default, GpuOptions { adapter: Some("lava".into()), memory_bytes: None, path: Path::Fast });
        for (text, bytes) in [("1500", 1500), ("0", 0), ("512 KiB", 512 << 10), ("3MiB", 3 << 20), ("20GiB", 20 << 30)]
        {
            assert_eq!(parse(Some(text), Some("fast")).map(|o| o.memory_bytes), Ok(Some(bytes)), "{text}");
        }
        assert_eq!(parse(None, Some("portable")).map(|o| o.path), Ok(Path::Portable));
        assert_eq!(parse(None, Some("half")).map(|o| o.path), Ok(Path::Half));
        for (memory, path) in [
            (Some("GiB"), None),
            (Some("-1"), None),
            (Some("1.5GiB"), None),
            (Some("1 TB"), None),
            (Some("99999999999999999999"), None),
            (Some("18446744073709551615GiB"), None),
            (None, Some("Portable")),
            (None, Some("quick\nly")),
        ] {
            let line = parse(memory, path).expect_err("an invalid value").to_string();
            assert!(line.contains("PLAT_GPU_") && !line.contains('\n'), "{line}");
        }
    }
}
