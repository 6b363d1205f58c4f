//! Where the taps of a sliding window read along one axis, forwards and backwards.

/// Most pixels from a window's first tap to its last, and from one window to the next.
const MAX_REACH: usize = 1 << 12;

/// A window that slides along one axis, as ONNX defines it for `Conv` and the pools.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    /// Positions of the input.
    pub(super) input: usize,
    /// Positions of the output.
    pub(super) output: usize,
    /// Taps of the window.
    pub(super) kernel: usize,
    /// Input positions from one output to the next.
    pub(super) stride: usize,
    /// Input positions from tap to tap.
    pub(super) dilation: usize,
    /// Zeros before the input.
    pub(super) pad: usize,
}

/// A tap: position `i` of `from..to` reads `first + step·i`, all others read nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tap {
    /// Its number in the kernel.
    pub(super) number: usize,
    pub(super) from: usize,
    pub(super) to: usize,
    pub(super) first: i64,
    pub(super) step: usize,
}

/// Every `step`-th position of a side, and the taps of these.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Phase {
    pub(super) start: usize,
    /// Number of its positions.
    pub(super) positions: usize,
    pub(super) taps: Vec<Tap>,
}

impl Tap {
    fn new(number: usize, first: i64, step: usize, positions: usize, readable: usize) -> Self {
        // The first position that reads at least `at`.
        let reaching = |at: i64| (at - first).max(0) as usize;
        let to = reaching(readable as i64).div_ceil(step).min(positions);
        Self { number, from: reaching(0).div_ceil(step).min(to), to, first, step }
    }

    /// What position `i` reads.
    pub(super) fn reads(&self, i: usize) -> Option<usize> {
        (self.from..self.to).contains(&i).then_some((self.first + (self.step * i) as i64) as usize)
    }
}

impl Axis {
    /// A window of this geometry with `pads` before and after, each smaller than the window. With `ceil`, windows may reach beyond the end, but none
    /// starts there.
    pub(super) fn new(
        input: usize,
        kernel: usize,
        stride: usize,
        dilation: usize,
        pads: [usize; 2],
        ceil: bool,
    ) -> Result<Self, String> {
        let no = || {
            format!(
                "has a window of {kernel} taps, stride {stride}, dilation {dilation} and pads {pads:?} on {input} pixels"
            )
        };
        let padded = input.saturating_add(pads[0]).saturating_add(pads[1]);
        let reach = kernel.saturating_sub(1).saturating_mul(dilation).saturating_add(1);
        let is_sane = kernel > 0 && dilation > 0 && (1..=MAX_REACH).contains(&stride) && reach <= MAX_REACH;
        if !is_sane || reach > padded || pads.iter().any(|&pad| pad >= reach) {
            return Err(no());
        }
        let span = padded - reach;
        let mut output = if ceil { span.div_ceil(stride) } else { span / stride } + 1;
        if (output - 1) * stride >= input + pads[0] {
            output -= 1;
        }
        Ok(Self { input, output, kernel, stride, dilation, pad: pads[0] })
    }

    /// What the taps of the output read of the input.
    pub(super) fn forward(&self) -> Vec<Phase> {
        let tap = |k: usize| {
            let first = (k * self.dilation) as i64 - self.pad as i64;
            Tap::new(k, first, self.stride, self.output, self.input)
        };
        vec![Phase { start: 0, positions: self.output, taps: (0..self.kernel).map(tap).collect() }]
    }

    /// What the taps of the input's gradient read of the output's gradient. Inputs whose positions leave the same rest
    /// by the stride are a phase: they are read by the same taps.
    pub(super) fn backward(&self) -> Vec<Phase> {
        let stride = self.stride as i64;
        let phase = |start: usize| {
            let positions = (self.input - start).div_ceil(self.stride);
            let tap = |k: usize| {
                let distance = (start + self.pad) as i64 - (k * self.dilation) as i64;
                let is_read = distance.rem_euclid(stride) == 0;
                is_read.then(|| Tap::new(k, distance / stride, 1, positions, self.output))
            };
            Phase { start, positions, taps: (0..self.kernel).filter_map(tap).collect() }
        };
        (0..self.stride.min(self.input)).map(phase).collect()
    }

    /// The input positions of a window, without those outside: for pools, whose dilation is 1.
    pub(super) fn window(&self, position: usize) -> std::ops::Range<usize> {
        let start = position * self.stride;
        let end = (start + self.kernel).saturating_sub(self.pad).min(self.input);
        start.saturating_sub(self.pad).min(end)..end
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backward_taps_are_the_transpose_of_forward_taps() {
        for (input, kernel, stride, dilation, pads) in [
            (7, 3, 1, 1, [1, 1]),
            (7, 3, 2, 1, [1, 1]),
            (9, 5, 3, 2, [4, 0]),
            (2, 1, 3, 1, [0, 0]),
            (8, 2, 2, 1, [0, 1]),
        ] {
            let axis = Axis::new(input, kernel, stride, dilation, pads, false).unwrap();
            let mut read: Vec<_> = axis.forward()[0]
                .taps
                .iter()
                .flat_map(|tap| (0..axis.output).filter_map(|i| Some((tap.number, i, tap.reads(i)?))))
                .collect();
            let mut written = Vec::new();
            for phase in axis.backward() {
                for i in 0..phase.positions {
                    let of = |tap: &Tap| Some((tap.number, tap.reads(i)?, phase.start + stride * i));
                    written.extend(phase.taps.iter().filter_map(of));
                }
            }
            read.sort_unstable();
            written.sort_unstable();
            assert_eq!(read, written, "{axis:?}");
        }
    }

    #[test]
    fn sizes_are_those_of_onnx() {
        let output =
            |input, kernel, stride, pads, ceil| Axis::new(input, kernel, stride, 1, pads, ceil).unwrap().output;
        assert_eq!(
            (output(416, 3, 2, [1, 1], false), output(5, 2, 2, [0, 0], false), output(5, 2, 2, [0, 0], true)),
            (208, 2, 3)
        );
        // A window that would start in the pad after the input is dropped.
        assert_eq!(output(4, 2, 4, [0, 1], true), 1);
        assert!(Axis::new(3, 4, 1, 1, [0, 0], false).is_err());
        assert!(Axis::new(3, 0, 1, 1, [0, 0], false).is_err());
        assert!(Axis::new(3, 1, usize::MAX, 1, [usize::MAX, 0], false).is_err());
    }
}
