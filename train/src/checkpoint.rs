//! What a training step leaves to the next, and its bytes: training goes on from it as if it had never stopped.

use render::cpu::Isa;
use scene::frame::{self, Kind};
use scene::{CodecError, Splats};
use serde::{Deserialize, Serialize};

use crate::growth::Evidence;
use crate::need::Need;
use crate::optimiser::Adam;

/// A checkpoint; the header is [`Header`], the bulk all columns of the splats and of both moments, then what was seen of each
/// splat since the last refinement: error, weight (f32) and views (u32).
const CHECKPOINT: Kind = Kind(*b"ckpt", 2);

/// All that a step depends on besides its job.
#[derive(Debug, Clone)]
pub struct State {
    /// Steps done.
    pub(crate) step: u32,
    /// Steps left out.
    pub(crate) skipped: u32,
    /// Splats that counted at first.
    pub(crate) start_count: usize,
    pub(crate) need: Need,
    pub(crate) splats: Splats,
    pub(crate) adam: Adam,
    pub(crate) evidence: Evidence,
}

#[derive(Serialize, Deserialize)]
struct Header {
    step: u32,
    skipped: u32,
    start_count: u64,
    need: Need,
    adam_step: i32,
    sh_degree: u8,
    count: u64,
    /// Splats that there is evidence of: all, or none since the last refinement.
    evident: u64,
}

impl State {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// As bytes, little endian.
    pub fn to_frame(&self) -> Vec<u8> {
        let Evidence { error, weight, views } = &self.evidence;
        let (adam_step, first, second) = self.adam.parts();
        let header = Header {
            step: self.step,
            skipped: self.skipped,
            start_count: self.start_count as u64,
            need: self.need.clone(),
            adam_step,
            sh_degree: self.splats.sh_degree(),
            count: self.splats.len() as u64,
            evident: views.len() as u64,
        };
        let columns = self.splats.columns().iter().chain(first).chain(second);
        let floats = columns.chain([error, weight]).flatten().flat_map(|value| value.to_le_bytes());
        let bulk: Vec<u8> = floats.chain(views.iter().flat_map(|value| value.to_le_bytes())).collect();
        frame::encode(CHECKPOINT, &header, &bulk)
    }

    /// From such bytes.
    ///
    /// # Errors
    /// Bytes that are no checkpoint of this version, or are damaged.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(CHECKPOINT, bytes)?;
        let wrong = || CodecError::new("a checkpoint's columns do not fit its header");
        if header.sh_degree > 3 {
            return Err(wrong());
        }
        let columns = Splats::new(header.sh_degree).columns().len();
        // A product of what the file says must be what the file is before anything is made of it.
        let words = u64::try_from(3 * columns).ok().and_then(|columns| columns.checked_mul(header.count));
        let words = words.and_then(|words| words.checked_add(header.evident.checked_mul(3)?));
        if words.and_then(|words| words.checked_mul(4)) != Some(bulk.len() as u64)
            || ![0, header.count].contains(&header.evident)
            || header.count == 0
        {
            return Err(wrong());
        }
        let (count, evident) = (header.count as usize, header.evident as usize);
        let (columns_bytes, evidence_bytes) = bulk.split_at(4 * count * 3 * columns);
        let word = |bytes: &[u8]| <[u8; 4]>::try_from(bytes).expect("four bytes");
        let floats =
            |bytes: &[u8]| -> Vec<f32> { bytes.chunks_exact(4).map(|bytes| f32::from_le_bytes(word(bytes))).collect() };
        let mut all = columns_bytes.chunks_exact(4 * count).map(floats);
        let splats = Splats::from_columns(all.by_ref().take(columns).collect()).ok_or_else(wrong)?;
        let first = all.by_ref().take(columns).collect();
        let second = all.collect();
        let part = |n: usize| &evidence_bytes[4 * evident * n..4 * evident * (n + 1)];
        let views = part(2).chunks_exact(4).map(|bytes| u32::from_le_bytes(word(bytes))).collect();
        Ok(Self {
            step: header.step,
            skipped: header.skipped,
            start_count: usize::try_from(header.start_count).map_err(|_| wrong())?,
            need: header.need,
            splats,
            adam: Adam::from_parts(Isa::detect(), header.adam_step, first, second),
            evidence: Evidence { error: floats(part(0)), weight: floats(part(1)), views },
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::Splat;

    use super::*;

    #[test]
    fn a_checkpoint_round_trips_and_damage_is_seen() {
        let mut splats = Splats::new(1);
        (0..20).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::splat(0.4), 0.3)));
        let moments = |add: f32| -> Vec<Vec<f32>> {
            let column = |(c, column): (usize, &Vec<f32>)| column.iter().map(|v| v * add + c as f32).collect();
            splats.columns().iter().enumerate().map(column).collect()
        };
        let evidence = Evidence { error: vec![0.5; 20], weight: vec![0.25; 20], views: (0..20).collect() };
        for evidence in [evidence, Evidence::default()] {
            let adam = Adam::from_parts(Isa::detect(), 41, moments(0.5), moments(2.0));
            let state = State {
                step: 40,
                skipped: 1,
                start_count: 7,
                need: Need::default(),
                splats: splats.clone(),
                adam,
                evidence,
            };
            let bytes = state.to_frame();
            let read = State::from_frame(&bytes).unwrap();
            assert_eq!((read.step, read.skipped, read.start_count), (40, 1, 7));
            assert!(read.splats == state.splats && read.adam.parts() == state.adam.parts());
            assert_eq!(read.evidence.views, state.evidence.views);
            assert_eq!((&read.evidence.error, &read.evidence.weight), (&state.evidence.error, &state.evidence.weight));
            assert!(read.to_frame() == bytes);
            assert!(State::from_frame(&bytes[..bytes.len() - 4]).is_err());
            assert!(State::from_frame(&[]).is_err());
        }
        // A header that promises what the bulk does not have.
        let header = Header {
            step: 1,
            skipped: 0,
            start_count: 0,
            need: Need::default(),
            adam_step: 1,
            sh_degree: 3,
            count: u64::MAX / 3,
            evident: 0,
        };
        assert!(State::from_frame(&frame::encode(CHECKPOINT, &header, &[0; 64])).is_err());
    }
}
