//! Sorts points along a Morton curve, so that neighbours in space are near each other in memory.

/// Row indices of three coordinate columns, sorted along a Morton curve with 10 bits per axis.
pub fn order(columns: [&[f32]; 3]) -> Vec<u32> {
    let n = columns[0].len();
    let spread = |v: u32| {
        // Two zero bits between the bits of a ten-bit number.
        let v = (v | v << 16) & 0x0300_00ff;
        let v = (v | v << 8) & 0x0300_f00f;
        let v = (v | v << 4) & 0x030c_30c3;
        (v | v << 2) & 0x0924_9249
    };
    let mut keys: Vec<(u32, u32)> = (0..n as u32).map(|i| (0, i)).collect();
    for (axis, column) in columns.into_iter().enumerate() {
        let mut sorted: Vec<f32> = column.to_vec();
        if sorted.is_empty() {
            return Vec::new();
        }
        // Scale to the middle 98 %, so that outliers do not squeeze the rest into one cell.
        let (low, high) = (n / 100, n - 1 - n / 100);
        let low = *sorted.select_nth_unstable_by(low, f32::total_cmp).1;
        let high = *sorted.select_nth_unstable_by(high, f32::total_cmp).1;
        let to_cells = 1023.0 / (high - low).max(1e-9);
        for (key, i) in &mut keys {
            let cell = ((column[*i as usize] - low) * to_cells).clamp(0.0, 1023.0) as u32;
            *key |= spread(cell) << axis;
        }
    }
    keys.sort_unstable();
    keys.into_iter().map(|(_, i)| i).collect()
}
