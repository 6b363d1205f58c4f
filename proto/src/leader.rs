//! The lease of the coordinator that leads, as it lies in the store: `leader/<epoch>.json`, the highest number counts.
//!
//! Whoever takes over has made its epoch sure in the durable state before, so no two coordinators write the same object, and
//! creating it needs no comparing and swapping. Its owner writes over it while it is alive, a higher beat each time. That tells
//! who to ask and when to take over; what keeps a coordinator that is late from doing harm is the fence of the durable state.

use serde::{Deserialize, Serialize};

/// Where leases lie among the records of a store.
pub const FOLDER: &str = "leader";
/// The longest lease that is read, in bytes.
const BYTES_LIMIT: usize = 4096;

/// A lease. A field that a later version adds is left out by those that do not know it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Leader {
    /// Under which epoch it grants; also the number of the object.
    pub epoch: u64,
    /// Where it is reached: `http://host:port` or `https://host:port`.
    pub address: String,
    /// Grows while it is alive.
    pub beat: u64,
    /// It has left, and whoever wants may follow at once.
    pub released: bool,
}

impl Leader {
    /// The name of its record.
    pub fn name(&self) -> String {
        name(self.epoch)
    }

    /// As it lies in the store.
    pub fn to_bytes(&self) -> Vec<u8> {
        // Plain fields always encode.
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// The lease of this number.
    ///
    /// # Errors
    /// What is wrong with it, as the rest of a line.
    pub fn from_bytes(epoch: u64, bytes: &[u8]) -> Result<Self, String> {
        let wrong = |what: String| format!("{} is no lease of a leader: {what}", name(epoch));
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
    fn a_lease_is_read_as_written_and_checked() {
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
