//! The leader's lease in the store: `leader/<epoch>.json`; the highest epoch is the current one.
//!
//! A new leader first makes its epoch durable in the state, so no two coordinators write the same object and creating it needs no
//! compare-and-swap. The leader overwrites its lease with a growing beat. Workers and clients find the leader by it, and standbys take
//! over when the beat stops. It does not fence: a late leader is fenced by the durable state.

use serde::{Deserialize, Serialize};

/// The folder of leases among a store's records.
pub const FOLDER: &str = "leader";
/// The largest lease that is read, in bytes.
const BYTES_LIMIT: usize = 4096;

/// A lease. Unknown fields, of later versions, are ignored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Leader {
    /// The leader's epoch; also the number of the object.
    pub epoch: u64,
    /// The leader's address: `http://host:port` or `https://host:port`.
    pub address: String,
    /// Heartbeat counter: grows while the leader is alive.
    pub beat: u64,
    /// The leader has shut down: a standby may take over at once.
    pub released: bool,
}

impl Leader {
    /// The name of its record.
    pub fn name(&self) -> String {
        name(self.epoch)
    }

    /// Encodes it for the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        // Plain fields always encode.
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// Decodes the lease of this epoch.
    ///
    /// # Errors
    /// What is wrong with it, as the rest of a line.
    pub fn from_bytes(epoch: u64, bytes: &[u8]) -> Result<Self, String> {
        let wrong = |problem: String| format!("{} is not a leader's lease: {problem}", name(epoch));
        if bytes.len() > BYTES_LIMIT {
            return Err(wrong(format!("it has {} bytes, at most {BYTES_LIMIT}", bytes.len())));
        }
        let lease: Self = serde_json::from_slice(bytes).map_err(|error| wrong(error.to_string()))?;
        let plain = lease.address.bytes().all(|byte| byte.is_ascii_graphic());
        if lease.epoch != epoch {
            return Err(wrong(format!("it is for epoch {}", lease.epoch)));
        }
        if !plain || !(lease.address.starts_with("http://") || lease.address.starts_with("https://")) {
            return Err(wrong("its address is not a URL".into()));
        }
        Ok(lease)
    }
}

/// The name of the lease of this epoch.
pub fn name(epoch: u64) -> String {
    format!("{FOLDER}/{epoch:06}.json")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lease_round_trips_and_is_checked() {
        let lease = Leader { epoch: 17, address: "http://10.0.0.7:7070".into(), beat: 3, released: false };
        assert_eq!(lease.name(), "leader/000017.json");
        assert_eq!(Leader::from_bytes(17, &lease.to_bytes()).unwrap(), lease);
        assert!(Leader::from_bytes(18, &lease.to_bytes()).unwrap_err().contains("leader/000018.json"));
        let far = Leader { address: "ftp://x".into(), ..lease.clone() };
        let broken = Leader { address: "http://x\ny".into(), ..lease };
        for bytes in [far.to_bytes(), broken.to_bytes(), b"{}".to_vec(), vec![b' '; 5000], vec![0xff]] {
            assert!(Leader::from_bytes(17, &bytes).is_err());
        }
    }
}
