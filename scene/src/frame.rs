//! The checksummed container format of plat's own files: plans, indices, checkpoints, splat columns.
//!
//! Layout, little endian: `"plat"`, four bytes of kind, version u32, header length u32, bulk length u64, the first 16
//! bytes of the BLAKE3 hash of header and bulk, the header (bincode through serde), the bulk (raw bytes).
//! bincode 2.0.1 is no longer developed; only this module calls it, with a size limit.

use serde::{Serialize, de::DeserializeOwned};

use crate::error::CodecError;
use crate::ids::ArtefactId;
use crate::splats::{Attribute, Splats};

const MAGIC: &[u8; 4] = b"plat";
const PREFIX: usize = 40;
/// Largest header that a reader accepts, bytes. A plan of 100,000 tasks needs about a tenth of it.
pub const HEADER_LIMIT: usize = 1 << 30;

/// A kind of frame and its format version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kind(pub [u8; 4], pub u32);

/// Splat columns; the header is [`SplatsHeader`].
pub const SPLATS: Kind = Kind(*b"spla", 2);
/// Splat columns with attributes; the header is a [`SplatsHeader`] and the attributes' names.
pub const SPLATS_WITH_ATTRIBUTES: Kind = Kind(*b"spla", 3);
/// Splat columns with attributes, trained with refined poses; the header is a [`SplatsHeader`], the attributes' names
/// and the artefact of the poses.
pub const SPLATS_WITH_POSES: Kind = Kind(*b"spla", 4);

/// Encodes a frame from a header and bulk bytes.
pub fn encode<T: Serialize>(kind: Kind, header: &T, bulk: &[u8]) -> Vec<u8> {
    let header = bincode::serde::encode_to_vec(header, bincode::config::standard())
        .expect("headers are plain data, which bincode always encodes");
    let mut bytes = Vec::with_capacity(PREFIX + header.len() + bulk.len());
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&kind.0);
    bytes.extend_from_slice(&kind.1.to_le_bytes());
    bytes.extend_from_slice(&u32::try_from(header.len()).expect("a header is under HEADER_LIMIT").to_le_bytes());
    bytes.extend_from_slice(&(bulk.len() as u64).to_le_bytes());
    bytes.extend_from_slice(&checksum(&header, bulk));
    bytes.extend_from_slice(&header);
    bytes.extend_from_slice(bulk);
    bytes
}

/// Decodes a frame of this kind: its header and a slice of its bulk.
///
/// # Errors
/// Wrong magic, kind, version, length or checksum, or a header with trailing bytes.
pub fn decode<T: DeserializeOwned>(kind: Kind, bytes: &[u8]) -> Result<(T, &[u8]), CodecError> {
    let name = String::from_utf8_lossy(&kind.0).into_owned();
    if bytes.len() < PREFIX || &bytes[..4] != MAGIC || bytes[4..8] != kind.0 {
        return Err(CodecError::new(format!("not a plat '{name}' frame")));
    }
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    if word(8) != kind.1 {
        return Err(CodecError::new(format!("'{name}' frame of version {}, this program reads {}", word(8), kind.1)));
    }
    let header_len = word(12) as usize;
    let bulk_len = u64::from_le_bytes(bytes[16..24].try_into().expect("eight bytes"));
    let length = bulk_len.checked_add((PREFIX + header_len) as u64);
    if header_len > HEADER_LIMIT || length != Some(bytes.len() as u64) {
        return Err(CodecError::new(format!("'{name}' frame is cut short or padded")));
    }
    let (header, bulk) = bytes[PREFIX..].split_at(header_len);
    if bytes[24..40] != checksum(header, bulk) {
        return Err(CodecError::new(format!("'{name}' frame fails its checksum")));
    }
    let (value, used) = decode_header(header).map_err(|e| CodecError::new(format!("'{name}' frame header: {e}")))?;
    if used != header.len() {
        return Err(CodecError::new(format!("'{name}' frame header has {} extra bytes", header.len() - used)));
    }
    Ok((value, bulk))
}

/// The header's value and the number of bytes it took.
///
/// bincode allocates the announced length of a string or vector, up to a limit that must be a compile-time constant.
/// This picks the smallest sufficient one of a few limits: no value claims more than eight bytes for each encoded byte.
fn decode_header<T: DeserializeOwned>(header: &[u8]) -> Result<(T, usize), bincode::error::DecodeError> {
    fn within<const LIMIT: usize, T: DeserializeOwned>(
        header: &[u8],
    ) -> Result<(T, usize), bincode::error::DecodeError> {
        bincode::serde::decode_from_slice(header, bincode::config::standard().with_limit::<LIMIT>())
    }
    const LIMITS: [usize; 5] = [1 << 16, 1 << 19, 1 << 22, 1 << 25, 1 << 28];
    match LIMITS.iter().position(|&limit| 8 * header.len() <= limit) {
        Some(0) => within::<{ LIMITS[0] }, T>(header),
        Some(1) => within::<{ LIMITS[1] }, T>(header),
        Some(2) => within::<{ LIMITS[2] }, T>(header),
        Some(3) => within::<{ LIMITS[3] }, T>(header),
        Some(4) => within::<{ LIMITS[4] }, T>(header),
        _ => within::<HEADER_LIMIT, T>(header),
    }
}

fn checksum(header: &[u8], bulk: &[u8]) -> [u8; 16] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(header).update(bulk);
    hasher.finalize().as_bytes()[..16].try_into().expect("16 of 32 bytes")
}

/// Header of a frame of splat columns.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SplatsHeader {
    /// SH degree.
    pub sh_degree: u8,
    /// Number of splats.
    pub count: u64,
    /// How the splats were trained.
    pub training: TrainingInfo,
}

/// How splats were trained, which the children of a block need.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TrainingInfo {
    /// The [`Exposures`](crate::Exposures) that the splats were trained with, if any.
    pub exposures: Option<ArtefactId>,
    /// Root mean square error of the tree's root block on its photos, 0 to 1.
    pub residual: Option<f64>,
    /// The [`Poses`](crate::Poses) that the splats were trained with, if they were refined. Only in frames of
    /// [`SPLATS_WITH_POSES`].
    #[serde(skip)]
    pub poses: Option<ArtefactId>,
}

/// Encodes splats: all columns one after the other, f32 little endian, then the attributes, u32 little endian.
pub fn encode_splats(splats: &Splats) -> Vec<u8> {
    encode_result(splats, TrainingInfo::default())
}

/// Encodes splats with their training information.
pub fn encode_result(splats: &Splats, training: TrainingInfo) -> Vec<u8> {
    let floats = splats.columns().iter().flat_map(|column| bytemuck::cast_slice::<f32, u8>(column));
    let integers = splats.attributes().iter().flat_map(|attribute| bytemuck::cast_slice::<u32, u8>(&attribute.values));
    let bulk: Vec<u8> = floats.chain(integers).copied().collect();
    let header = SplatsHeader { sh_degree: splats.sh_degree(), count: splats.len() as u64, training };
    // Splats without attributes or poses keep the bytes, and so the id, that they had before these existed.
    match (splats.attribute_names(), training.poses) {
        (names, Some(poses)) => encode(SPLATS_WITH_POSES, &(header, names, poses), &bulk),
        (names, None) if names.is_empty() => encode(SPLATS, &header, &bulk),
        (names, None) => encode(SPLATS_WITH_ATTRIBUTES, &(header, names), &bulk),
    }
}

/// Splats with attributes of these names, from their values one attribute after the other, u32 little endian.
///
/// # Errors
/// Names that are not sorted, not unique or not [valid](Attribute::is_name), or too many; bytes of another length.
pub fn with_attributes(mut splats: Splats, names: &[String], bytes: &[u8]) -> Result<Splats, CodecError> {
    let sorted = names.windows(2).all(|pair| pair[0] < pair[1]);
    if !sorted || names.len() > Attribute::MAX_COUNT || !names.iter().all(|name| Attribute::is_name(name)) {
        return Err(CodecError::new("names of attributes are not valid"));
    }
    if Some(bytes.len()) != splats.len().checked_mul(4 * names.len()) {
        return Err(CodecError::new("attributes do not match their header"));
    }
    for (i, name) in names.iter().enumerate() {
        let column = &bytes[4 * splats.len() * i..4 * splats.len() * (i + 1)];
        let values = column.chunks_exact(4).map(|b| u32::from_le_bytes(b.try_into().expect("four bytes"))).collect();
        splats.set_attribute(name, values);
    }
    Ok(splats)
}

/// Decodes splats.
///
/// # Errors
/// As [`decode_result`].
pub fn decode_splats(bytes: &[u8]) -> Result<Splats, CodecError> {
    decode_result(bytes).map(|(splats, _)| splats)
}

/// Decodes splats with their training information.
///
/// # Errors
/// As [`decode`], or a bulk whose length does not match the header.
pub fn decode_result(bytes: &[u8]) -> Result<(Splats, TrainingInfo), CodecError> {
    let has_version = |kind: Kind| bytes.get(8..12) == Some(&kind.1.to_le_bytes()[..]);
    let (mut header, names, poses, bulk): (SplatsHeader, Vec<String>, _, _) = if has_version(SPLATS_WITH_POSES) {
        let ((header, names, poses), bulk) = decode(SPLATS_WITH_POSES, bytes)?;
        (header, names, Some(poses), bulk)
    } else if has_version(SPLATS_WITH_ATTRIBUTES) {
        let ((header, names), bulk) = decode(SPLATS_WITH_ATTRIBUTES, bytes)?;
        (header, names, None, bulk)
    } else {
        let (header, bulk) = decode(SPLATS, bytes)?;
        (header, Vec::new(), None, bulk)
    };
    header.training.poses = poses;
    if header.sh_degree > 3 {
        return Err(CodecError::new(format!("SH degree {} is above 3", header.sh_degree)));
    }
    let columns = Splats::new(header.sh_degree).columns().len();
    let row = 4 * (columns as u64 + names.len().min(Attribute::MAX_COUNT) as u64);
    if header.count.checked_mul(row) != Some(bulk.len() as u64) {
        return Err(CodecError::new("splat columns do not match their header"));
    }
    if header.count == 0 {
        return Ok((with_attributes(Splats::new(header.sh_degree), &names, &[])?, header.training));
    }
    let (bulk, attributes) = bulk.split_at(4 * columns * header.count as usize);
    let values =
        |chunk: &[u8]| chunk.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("four bytes"))).collect();
    let columns = bulk.chunks_exact(4 * header.count as usize).map(values).collect();
    let splats = Splats::from_columns(columns).ok_or_else(|| CodecError::new("splat columns of unequal length"))?;
    Ok((with_attributes(splats, &names, attributes)?, header.training))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::splats::Splat;
    use glam::Vec3;

    #[test]
    fn headers_cannot_allocate_more_than_they_hold() {
        // A string with an announced length of 900 MB.
        let mut bytes = vec![252];
        bytes.extend(900_000_000u32.to_le_bytes());
        assert!(matches!(decode_header::<String>(&bytes), Err(bincode::error::DecodeError::LimitExceeded)));
        // Headers just below and above a limit are decoded: numbers that take one byte and claim eight, and strings.
        for length in [1 << 13, (1 << 13) + 1, 1 << 16, (1 << 16) + 1] {
            let (numbers, text) = (vec![7u64; length], "x".repeat(length));
            let frame = encode(SPLATS, &(&numbers, &text), &[]);
            assert_eq!(decode(SPLATS, &frame).map(|(header, _)| header), Ok((numbers, text)));
        }
    }

    #[test]
    fn splats_round_trip_and_damage_is_detected() {
        let mut splats = Splats::new(1);
        for i in 0..5 {
            splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::splat(0.4), 0.3));
        }
        let bytes = encode_splats(&splats);
        assert_eq!(decode_result(&bytes).unwrap(), (splats.clone(), TrainingInfo::default()));
        let training = TrainingInfo { exposures: Some(ArtefactId::of(b"exposures")), residual: Some(0.1), poses: None };
        let exposed = encode_result(&splats, training);
        assert_eq!(decode_result(&exposed).unwrap(), (splats.clone(), training));
        let mut labelled = splats.clone();
        labelled.set_attribute("block", vec![1, 2, 3, 4, 5]);
        labelled.set_attribute("label", vec![9; 5]);
        let with_attributes = encode_result(&labelled, training);
        assert_eq!(decode_result(&with_attributes).unwrap(), (labelled.clone(), training));
        let refined = TrainingInfo { poses: Some(ArtefactId::of(b"poses")), ..training };
        for splats in [&splats, &labelled] {
            assert_eq!(decode_result(&encode_result(splats, refined)).unwrap(), (splats.clone(), refined));
        }
        let with_poses = encode_result(&labelled, refined);
        for bytes in [&bytes, &with_attributes, &with_poses] {
            for at in 0..bytes.len() {
                let mut damaged = bytes.clone();
                damaged[at] ^= 0x40;
                assert!(decode_splats(&damaged).is_err(), "flip at {at} was not detected");
            }
        }
        for names in [vec!["b".to_owned(), "a".into()], vec!["Label".into()], vec!["a".into(); 2]] {
            let header = SplatsHeader { sh_degree: 0, count: 0, training };
            assert!(decode_splats(&encode(SPLATS_WITH_ATTRIBUTES, &(header, names), &[])).is_err());
        }
        assert!(decode_splats(&bytes[..bytes.len() - 1]).is_err());
        let mut oversized = bytes;
        oversized[16..24].fill(0xff);
        assert!(decode_splats(&oversized).unwrap_err().0.contains("cut short"));
    }
}
