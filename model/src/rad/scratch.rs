//! Files beside the output that are removed when they are dropped.

use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use glam::{Quat, Vec3};
use scene::rad::{Children, Gaussian, Node, Part};
use store::file::AtomicFile;

use crate::error::{ModelError, cannot};

/// Bytes of a node: 59 numbers, then where its children are.
const NODE_BYTES: usize = 4 * 59 + 8 + 2 + 1;
/// Bytes that are copied at once.
const COPIED_BYTES: usize = 1 << 20;

/// Bytes that are appended and copied once.
pub(super) struct Bytes {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Bytes {
    /// A file named after `out` and `name`, in its folder.
    pub(super) fn create(out: &Path, name: &str) -> Result<Self, ModelError> {
        let mut path = out.as_os_str().to_owned();
        path.push(format!(".{name}.scratch"));
        let path = PathBuf::from(path);
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(true).open(&path);
        let file = file.map_err(cannot("made", &path))?;
        Ok(Self { path, file: BufWriter::with_capacity(COPIED_BYTES, file) })
    }

    pub(super) fn append(&mut self, bytes: &[u8]) -> Result<(), ModelError> {
        self.file.write_all(bytes).map_err(cannot("written", &self.path))
    }

    fn read(&mut self, at: u64, bytes: &mut [u8]) -> Result<(), ModelError> {
        let mut read = || {
            self.file.flush()?;
            let file = self.file.get_mut();
            file.seek(SeekFrom::Start(at))?;
            file.read_exact(bytes)
        };
        read().map_err(cannot("read", &self.path))
    }

    pub(super) fn copy_to(&mut self, to: &mut AtomicFile) -> Result<(), ModelError> {
        let length = self.file.stream_position().map_err(cannot("read", &self.path))?;
        for at in (0..length).step_by(COPIED_BYTES) {
            let mut bytes = vec![0; (length - at).min(COPIED_BYTES as u64) as usize];
            self.read(at, &mut bytes)?;
            to.write(&bytes)?;
        }
        Ok(())
    }
}

impl Drop for Bytes {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.path);
    }
}

/// Nodes that are appended, then read backwards.
pub(super) struct Nodes {
    bytes: Bytes,
    count: u64,
}

impl Nodes {
    pub(super) fn create(out: &Path, name: &str) -> Result<Self, ModelError> {
        Ok(Self { bytes: Bytes::create(out, name)?, count: 0 })
    }

    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// Appends nodes and returns how many were there before.
    pub(super) fn append(&mut self, nodes: &[Node]) -> Result<u64, ModelError> {
        for node in nodes {
            self.bytes.append(&to_bytes(node))?;
        }
        self.count += nodes.len() as u64;
        Ok(self.count - nodes.len() as u64)
    }

    /// The nodes from `from` to before `to`, counted from the last.
    pub(super) fn backwards(&mut self, from: u64, to: u64) -> Result<Vec<Node>, ModelError> {
        let mut bytes = vec![0; (to - from) as usize * NODE_BYTES];
        self.bytes.read((self.count - to) * NODE_BYTES as u64, &mut bytes)?;
        Ok(bytes.as_chunks().0.iter().rev().map(of_bytes).collect())
    }
}

fn to_bytes(node: &Node) -> [u8; NODE_BYTES] {
    let Gaussian { mean, scale, quat, opacity, sh } = &node.gaussian;
    let shape = mean.to_array().into_iter().chain(scale.to_array()).chain(quat.to_array()).chain([*opacity]);
    let mut bytes = [0; NODE_BYTES];
    let (numbers, rest) = bytes.split_at_mut(4 * 59);
    for (to, value) in numbers.as_chunks_mut().0.iter_mut().zip(shape.chain(sh.as_flattened().iter().copied())) {
        *to = value.to_le_bytes();
    }
    rest[..8].copy_from_slice(&node.children.start.to_le_bytes());
    rest[8..10].copy_from_slice(&node.children.count.to_le_bytes());
    rest[10] = u8::from(node.children.part == Part::Top);
    bytes
}

fn of_bytes(bytes: &[u8; NODE_BYTES]) -> Node {
    let (numbers, rest) = bytes.split_at(4 * 59);
    let mut values = [0.0; 59];
    values.iter_mut().zip(numbers.as_chunks().0).for_each(|(value, bytes)| *value = f32::from_le_bytes(*bytes));
    let mut sh = [[0.0; 3]; 16];
    sh.as_flattened_mut().copy_from_slice(&values[11..]);
    let gaussian = Gaussian {
        mean: Vec3::from_slice(&values),
        scale: Vec3::from_slice(&values[3..]),
        quat: Quat::from_slice(&values[6..]),
        opacity: values[10],
        sh,
    };
    let start = rest[..8].iter().rev().fold(0, |start, &byte| start << 8 | u64::from(byte));
    let part = if rest[10] == 1 { Part::Top } else { Part::Below };
    Node { gaussian, children: Children { start, count: u16::from_le_bytes([rest[8], rest[9]]), part } }
}
