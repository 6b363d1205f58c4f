// Pictures and splats that the mock serves: small, drawn by seed, without dependencies.
import { deflateSync, gzipSync, crc32 } from 'node:zlib';
import { hash } from './world.mjs';

/** A street front. */
export function picture(seed, width = 320, height = 200) {
  const rgb = Buffer.alloc((width * 3 + 1) * height);
  const houses = 9;
  for (let j = 0; j < height; j += 1) for (let i = 0; i < width; i += 1) {
    const u = i / width;
    const v = j / height;
    const house = Math.floor(u * houses);
    const top = 0.2 + 0.35 * hash(seed, house, 1);
    let c;
    if (v > 0.8) c = [105, 105, 110];
    else if (v > top) {
      const window = (u * houses * 3) % 1 > 0.55 && ((v - top) * 14) % 1 > 0.5;
      c = window ? [60, 75, 95] : [150 + 80 * hash(seed, house, 2), 120 + 60 * hash(seed, house, 3), 95 + 50 * hash(seed, house, 4)];
    } else c = [150 + 60 * v, 185 + 40 * v, 230];
    const noise = (hash(seed, i, j) - 0.5) * 16;
    const at = j * (width * 3 + 1) + 1 + 3 * i;
    for (let k = 0; k < 3; k += 1) rgb[at + k] = Math.max(0, Math.min(255, c[k] + noise));
  }
  return png(rgb, width, height);
}

function png(raw, width, height) {
  const header = Buffer.alloc(13);
  header.writeUInt32BE(width, 0);
  header.writeUInt32BE(height, 4);
  header.set([8, 2, 0, 0, 0], 8);
  return Buffer.concat([
    Buffer.from([137, 80, 78, 71, 13, 10, 26, 10]),
    chunk('IHDR', header), chunk('IDAT', deflateSync(raw, { level: 3 })), chunk('IEND', Buffer.alloc(0)),
  ]);
}

function chunk(type, data) {
  const body = Buffer.concat([Buffer.from(type, 'latin1'), data]);
  const out = Buffer.alloc(body.length + 8);
  out.writeUInt32BE(data.length, 0);
  body.copy(out, 4);
  out.writeUInt32BE(crc32(body), body.length + 4);
  return out;
}

/** SPZ v3: houses of coloured splats over the square, each `count` splats. Positions in metres. */
export function spz(seed, square, count) {
  const bytes = Buffer.alloc(16 + count * (9 + 1 + 3 + 3 + 4));
  bytes.writeUInt32LE(0x5053474e, 0);
  bytes.writeUInt32LE(3, 4);
  bytes.writeUInt32LE(count, 8);
  const fraction = 8;
  bytes.set([0, fraction, 0, 0], 12);
  const positions = 16;
  const alphas = positions + 9 * count;
  const colours = alphas + count;
  const scales = colours + 3 * count;
  const rotations = scales + 3 * count;
  const size = Math.log(Math.max(0.4, (square.edge / Math.sqrt(count)) * 0.5));
  for (let i = 0; i < count; i += 1) {
    const u = hash(seed, i, 1);
    const v = hash(seed, i, 2);
    const x = square.x + u * square.edge;
    const y = square.y + v * square.edge;
    const cell = [Math.floor(x / 25), Math.floor(y / 25)];
    const house = hash(cell[0], cell[1], 5) > 0.35;
    const tall = 8 + 25 * hash(cell[0], cell[1], 6);
    const z = house ? tall * hash(seed, i, 3) : 0;
    // SPZ's y and z are those of a PLY with the other sign.
    [x, -y, -z].forEach((p, k) => bytes.writeIntLE(Math.round(p * 2 ** fraction), positions + 9 * i + 3 * k, 3));
    bytes[alphas + i] = 225;
    const tint = house ? [0.55 + 0.4 * hash(cell[0], cell[1], 7), 0.45 + 0.3 * hash(cell[0], cell[1], 8), 0.4] : [0.36, 0.38, 0.36];
    tint.forEach((c, k) => { bytes[colours + 3 * i + k] = Math.max(0, Math.min(255, ((c - 0.5) / 0.2820948) * 0.15 * 255 + 127.5)); });
    for (let k = 0; k < 3; k += 1) bytes[scales + 3 * i + k] = Math.max(0, Math.min(255, Math.round((size + 10) * 16)));
    bytes.writeUInt32LE((3 << 30) >>> 0, rotations + 4 * i);
  }
  return gzipSync(bytes, { level: 1 });
}
