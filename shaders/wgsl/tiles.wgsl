// The tiles that the ellipse of a record at alpha = 1/255 overlaps. `project` counts them and `emit` lists them. Both
// must agree, so sums of products are explicit fma, which leaves the compiler no choice of rounding.

struct TileBox {
    first: vec2<u32>,
    end: vec2<u32>,
}

// The tiles of the ellipse's bounding box; extents are below 1e7.
fn tile_box(r: Record, tiles: vec2<u32>) -> TileBox {
    let low = max((r.mean_ab.xy - r.c_opacity_extent.zw - 0.5) * 0.0625, vec2<f32>(0.0));
    let high = max((r.mean_ab.xy + r.c_opacity_extent.zw - 0.5) * 0.0625, vec2<f32>(0.0));
    return TileBox(vec2<u32>(low), min(vec2<u32>(high) + 1u, tiles));
}

struct Ellipse {
    mean: vec2<f32>,
    a: f32,
    b: f32,
    c: f32,
    // Position of the largest exponent on a vertical line (times x) and on a horizontal line (times y).
    on_column: f32,
    on_row: f32,
    // Upper bound of the sum of squares.
    reach: f32,
}

fn ellipse(r: Record) -> Ellipse {
    let a = r.mean_ab.z;
    let b = r.mean_ab.w;
    let c = r.c_opacity_extent.x;
    // log2(1/255) is -7.9943534. The slack covers rounding; the rasterizer tests each pixel itself.
    return Ellipse(r.mean_ab.xy, a, b, c, -(a * b) / fma(b, b, c * c), -b / a, r.c_opacity_extent.y + 7.9953534);
}

fn overlaps(e: Ellipse, tile: vec2<u32>) -> bool {
    // Pixel centres of the tile's corners, relative to the mean.
    let low = vec2<f32>(tile * TILE) + 0.5 - e.mean;
    let high = low + 15.0;
    let near = max(low, min(vec2<f32>(0.0), high));
    // The largest exponent over a tile lies on the vertical or horizontal line nearest to the mean.
    let y = min(max(e.on_column * near.x, low.y), high.y);
    let u0 = fma(e.a, near.x, e.b * y);
    let v0 = e.c * y;
    let x = min(max(e.on_row * near.y, low.x), high.x);
    let u1 = fma(e.a, x, e.b * near.y);
    let v1 = e.c * near.y;
    return min(fma(u0, u0, v0 * v0), fma(u1, u1, v1 * v1)) <= e.reach;
}
