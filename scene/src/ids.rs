//! Identifiers of blocks and of immutable artefacts.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::CodecError;

/// A block of the quadtree: level 0 is the whole scene, level `L` has `2^L × 2^L` blocks. Written `L/x/y`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct BlockId {
    /// Depth in the tree, 0 at the root; at most [`BlockId::MAX_LEVEL`].
    pub level: u8,
    /// Column, `0 .. 2^level`, growing with the ground's first axis.
    pub x: u32,
    /// Row, `0 .. 2^level`, growing with the ground's second axis.
    pub y: u32,
}

impl BlockId {
    /// The block that covers the whole scene.
    pub const ROOT: Self = Self { level: 0, x: 0, y: 0 };
    /// Deepest level: 2^20 blocks per side are blocks of 1 m in a scene of 1,000 km.
    pub const MAX_LEVEL: u8 = 20;
    /// Deepest level whose blocks have a [`BlockId::code`] of 32 bits.
    pub const MAX_CODE_LEVEL: u8 = 15;

    /// The block one level up, `None` at the root.
    pub fn parent(self) -> Option<Self> {
        (self.level > 0).then(|| Self { level: self.level - 1, x: self.x / 2, y: self.y / 2 })
    }

    /// The four blocks one level down, in (y, x) order.
    pub fn children(self) -> [Self; 4] {
        let child = |i: u32| Self { level: self.level + 1, x: self.x * 2 + (i & 1), y: self.y * 2 + (i >> 1) };
        [child(0), child(1), child(2), child(3)]
    }

    /// A number for the block, from 1 on: blocks by level, then in Morton order. Labels splats with their block
    /// ([`BLOCK_ATTRIBUTE`](crate::splats::BLOCK_ATTRIBUTE)). `None` below [`BlockId::MAX_CODE_LEVEL`].
    pub fn code(self) -> Option<u32> {
        let spread = |value: u32| (0..16).fold(0u32, |code, bit| code | (value >> bit & 1) << (2 * bit));
        let before = |level: u8| ((1u64 << (2 * level)) / 3) as u32;
        (self.level <= Self::MAX_CODE_LEVEL).then(|| 1 + before(self.level) + (spread(self.x) | spread(self.y) << 1))
    }

    /// The block with this [`BlockId::code`].
    pub fn from_code(code: u32) -> Option<Self> {
        let index = code.checked_sub(1)?;
        let before = |level: u8| ((1u64 << (2 * level)) / 3) as u32;
        let level = (0..=Self::MAX_CODE_LEVEL).rev().find(|&level| index >= before(level))?;
        let morton = index - before(level);
        let gather = |code: u32| (0..16).fold(0u32, |value, bit| value | (code >> (2 * bit) & 1) << bit);
        let block = Self { level, x: gather(morton), y: gather(morton >> 1) };
        (block.x >> level == 0 && block.y >> level == 0).then_some(block)
    }

    /// The ancestor at `level`; the block itself if `level >= self.level`.
    pub fn ancestor(self, level: u8) -> Self {
        if level >= self.level {
            return self;
        }
        let up = self.level - level;
        Self { level, x: self.x >> up, y: self.y >> up }
    }
}

impl fmt::Display for BlockId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/{}", self.level, self.x, self.y)
    }
}

impl FromStr for BlockId {
    type Err = CodecError;

    fn from_str(text: &str) -> Result<Self, CodecError> {
        let bad = || CodecError::new(format!("'{text}' is not a block id of the form level/x/y"));
        let mut parts = text.split('/').map(str::parse::<u32>);
        let mut next = || parts.next().and_then(Result::ok).ok_or_else(bad);
        let (level, x, y) = (next()?, next()?, next()?);
        if parts.next().is_some() || level > u32::from(Self::MAX_LEVEL) || x >> level != 0 || y >> level != 0 {
            return Err(bad());
        }
        Ok(Self { level: level as u8, x, y })
    }
}

/// The BLAKE3 hash of an artefact's bytes, which is its key in the store. Written as 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArtefactId(pub [u8; 32]);

impl ArtefactId {
    /// The id of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(*blake3::hash(bytes).as_bytes())
    }

    /// The leading 64 bits, as a seed for counter-based random numbers.
    pub fn seed(&self) -> u64 {
        u64::from_le_bytes(self.0[..8].try_into().expect("eight of 32 bytes"))
    }
}

impl fmt::Display for ArtefactId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for ArtefactId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for ArtefactId {
    type Err = CodecError;

    fn from_str(text: &str) -> Result<Self, CodecError> {
        let bad = || CodecError::new("an artefact id is 64 hexadecimal digits".to_string());
        let digits = text.as_bytes();
        if digits.len() != 64 || !digits.iter().all(|d| matches!(d, b'0'..=b'9' | b'a'..=b'f')) {
            return Err(bad());
        }
        let mut id = [0u8; 32];
        for (byte, pair) in id.iter_mut().zip(digits.chunks_exact(2)) {
            let pair = std::str::from_utf8(pair).map_err(|_| bad())?;
            *byte = u8::from_str_radix(pair, 16).map_err(|_| bad())?;
        }
        Ok(Self(id))
    }
}

impl Serialize for ArtefactId {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        if to.is_human_readable() { to.collect_str(self) } else { self.0.serialize(to) }
    }
}

impl<'de> Deserialize<'de> for ArtefactId {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        if from.is_human_readable() {
            String::deserialize(from)?.parse().map_err(serde::de::Error::custom)
        } else {
            Ok(Self(<[u8; 32]>::deserialize(from)?))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn block_ids_round_trip_and_nest() {
        let block: BlockId = "3/5/2".parse().unwrap();
        assert_eq!(block.to_string(), "3/5/2");
        assert!(block.children().iter().all(|c| c.parent() == Some(block)));
        assert_eq!(block.ancestor(0), BlockId::ROOT);
        for bad in ["", "3", "3/8/0", "3/0/0/0", "21/0/0", "-1/0/0", "a/b/c"] {
            assert!(bad.parse::<BlockId>().is_err(), "{bad}");
        }
    }

    #[test]
    fn block_codes_are_unique_and_round_trip() {
        let mut codes = Vec::new();
        for level in 0..4u8 {
            let side = 0..1u32 << level;
            for block in side.clone().flat_map(|y| side.clone().map(move |x| BlockId { level, x, y })) {
                let code = block.code().unwrap();
                assert_eq!(BlockId::from_code(code), Some(block));
                codes.push(code);
            }
        }
        codes.sort_unstable();
        assert_eq!(codes, (1..=85).collect::<Vec<u32>>());
        let last = BlockId { level: 15, x: (1 << 15) - 1, y: (1 << 15) - 1 };
        assert_eq!(last.code().and_then(BlockId::from_code), Some(last));
        assert_eq!(BlockId { level: 16, x: 0, y: 0 }.code(), None);
        assert_eq!([0, last.code().unwrap() + 1, u32::MAX].map(BlockId::from_code), [None; 3]);
    }

    #[test]
    fn artefact_ids_round_trip() {
        let id = ArtefactId::of(b"plat");
        assert_eq!(id.to_string().parse::<ArtefactId>().unwrap(), id);
        for bad in ["zz", "+f", "AB"] {
            assert!(bad.repeat(32).parse::<ArtefactId>().is_err(), "{bad}");
        }
    }
}
