//! How a device is opened, and what of it the environment says.

use super::error::GpuError;

/// How a device is opened. None of it changes what is computed, but for the path, which the backend's name shows.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct GpuOptions {
    /// A part of the adapter's name, in any case; `None`: the most powerful one.
    pub adapter: Option<String>,
    /// Most bytes that buffers may take together; `None`: what the driver gives.
    pub memory_bytes: Option<u64>,
    /// Which stages run.
    pub path: Path,
}

/// Which stages run: those of one path have the same bits, those of another others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Path {
    /// Those that every adapter runs.
    Portable,
    /// Where an adapter has subgroups of one size, those; else the portable ones.
    #[default]
    Fast,
    /// Those with subgroups, and gradients that wait in workgroup memory in half precision: less of it to write and to read, for
    /// sums that are right to three digits. An adapter without either is refused.
    Half,
}

impl GpuOptions {
    /// From `PLAT_GPU_ADAPTER`, `PLAT_GPU_MEMORY` (a number of bytes, KiB, MiB or GiB) and `PLAT_GPU_PATH` (`fast`,
    /// `portable` or `half`). What is not set, or empty, is the default.
    ///
    /// # Errors
    /// A value that means nothing.
    pub fn from_env() -> Result<Self, GpuError> {
        let of = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        Self::parse(of("PLAT_GPU_ADAPTER"), of("PLAT_GPU_MEMORY"), of("PLAT_GPU_PATH"))
    }

    fn parse(adapter: Option<String>, memory: Option<String>, path: Option<String>) -> Result<Self, GpuError> {
        let wrong = |name, value: String, wanted| {
            Err(GpuError::Setting { name, value: super::error::one_line(&value), wanted })
        };
        let memory_bytes = match memory {
            Some(text) => match bytes_of(&text) {
                Some(bytes) => Some(bytes),
                None => return wrong("PLAT_GPU_MEMORY", text, "a size as 512MiB or 20GiB"),
            },
            None => None,
        };
        let path = match path.as_deref() {
            None | Some("fast") => Path::Fast,
            Some("portable") => Path::Portable,
            Some("half") => Path::Half,
            Some(other) => return wrong("PLAT_GPU_PATH", other.into(), "fast, portable or half"),
        };
        Ok(Self { adapter, memory_bytes, path })
    }
}

/// "1500", "512 KiB", "20GiB".
fn bytes_of(text: &str) -> Option<u64> {
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
    fn the_environment_is_read_or_refused() {
        let of = |memory: Option<&str>, path: Option<&str>| {
            GpuOptions::parse(Some("lava".into()), memory.map(Into::into), path.map(Into::into))
        };
        let plain = of(None, None).expect("nothing is wrong with nothing");
        assert_eq!(plain, GpuOptions { adapter: Some("lava".into()), memory_bytes: None, path: Path::Fast });
        for (text, bytes) in [("1500", 1500), ("0", 0), ("512 KiB", 512 << 10), ("3MiB", 3 << 20), ("20GiB", 20 << 30)]
        {
            assert_eq!(of(Some(text), Some("fast")).map(|o| o.memory_bytes), Ok(Some(bytes)), "{text}");
        }
        assert_eq!(of(None, Some("portable")).map(|o| o.path), Ok(Path::Portable));
        assert_eq!(of(None, Some("half")).map(|o| o.path), Ok(Path::Half));
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
            let line = of(memory, path).expect_err("it means nothing").to_string();
            assert!(line.contains("PLAT_GPU_") && !line.contains('\n'), "{line}");
        }
    }
}
