//! Tile indexes and compressed tiles shared between the readers of one capture.

use std::ops::Range;
use std::sync::{Arc, Mutex};

use bytes::Bytes;

use super::locks::lock;
use crate::byte_lru::ByteLru;
use crate::mip_tiles::TileIndex;

/// A view and one of its mips.
pub(super) type Mip = (u32, u8);

/// An LRU cache of tile indexes and, optionally, of compressed tiles, for readers of the same capture. A cached index saves one
/// of the two requests of a window. Cached tiles save the second where neighbouring blocks read the same parts of photos.
#[derive(Debug)]
pub struct SharedTileCache {
    indexes: Mutex<ByteLru<Mip, Arc<TileIndex>>>,
    /// By mip and start in its artefact.
    tiles: Mutex<ByteLru<(Mip, u64), Bytes>>,
}

impl SharedTileCache {
    /// Room for the indexes of the mips of some thousand photos.
    const INDEX_BYTES: usize = 32 << 20;
    /// Approximate overhead of a cached tile, bytes.
    const TILE_OVERHEAD_BYTES: usize = 96;

    /// A cache of at most `tile_bytes` bytes of compressed tiles. 0 suits a local store, whose reads are as fast.
    pub fn new(tile_bytes: usize) -> Self {
        Self { indexes: Mutex::new(ByteLru::new(Self::INDEX_BYTES)), tiles: Mutex::new(ByteLru::new(tile_bytes)) }
    }

    pub(super) fn index(&self, mip: Mip) -> Option<Arc<TileIndex>> {
        lock(&self.indexes).get(&mip).cloned()
    }

    pub(super) fn insert_index(&self, mip: Mip, index: &Arc<TileIndex>) {
        lock(&self.indexes).insert_if_absent(mip, Arc::clone(index), index.memory_bytes());
    }

    /// The cached tiles among those of these byte ranges.
    pub(super) fn tiles(&self, mip: Mip, ranges: &[Range<u64>]) -> Vec<Option<Bytes>> {
        let mut tiles = lock(&self.tiles);
        ranges.iter().map(|range| tiles.get(&(mip, range.start)).cloned()).collect()
    }

    /// Caches tiles, given with their starts in the artefact. The caller has verified their checksums by decoding them.
    pub(super) fn insert_tiles(&self, mip: Mip, read: impl Iterator<Item = (u64, Bytes)>) {
        let mut tiles = lock(&self.tiles);
        if tiles.limit() > 0 {
            for (start, tile) in read {
                // A copy: the slice would keep all coalesced ranges of its request alive.
                let tile = Bytes::copy_from_slice(&tile);
                let bytes = tile.len() + Self::TILE_OVERHEAD_BYTES;
                tiles.insert_if_absent((mip, start), tile, bytes);
            }
        }
    }
}
