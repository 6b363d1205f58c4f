// Rectangles into an array of pixels. 10,000 blocks and 20,000 points take milliseconds; through the canvas's own
// fillRect they take a third of a second.

export class Raster {
  private readonly image: ImageData;
  private readonly pixels: Uint32Array;

  constructor(readonly width: number, readonly height: number) {
    this.image = new ImageData(width, height);
    this.pixels = new Uint32Array(this.image.data.buffer);
  }

  clear(colour: string): void {
    this.pixels.fill(packed(colour));
  }

  rect(x: number, y: number, w: number, h: number, colour: number): void {
    const [x0, x1] = [Math.max(0, x), Math.min(this.width, x + w)];
    const [y0, y1] = [Math.max(0, y), Math.min(this.height, y + h)];
    if (x0 >= x1) return;
    for (let row = y0; row < y1; row += 1) this.pixels.fill(colour, row * this.width + x0, row * this.width + x1);
  }

  /** White stripes, or stripes both ways: what is failed or quarantined must show without its colour. */
  hatch(x: number, y: number, w: number, h: number, cross: boolean): void {
    const [x0, x1] = [Math.max(0, x), Math.min(this.width, x + w)];
    for (let row = Math.max(0, y); row < Math.min(this.height, y + h); row += 1) {
      for (let at = x0; at < x1; at += 1) {
        if ((at + row) % 6 !== 0 && !(cross && (at - row + 6000000) % 6 === 0)) continue;
        const i = row * this.width + at;
        this.pixels[i] = mixed(this.pixels[i]!, 0xffffffff, 0.6);
      }
    }
  }

  /** A dot of `size` pixels, blended over what is there. */
  dot(x: number, y: number, size: number, colour: number, alpha: number): void {
    for (let row = Math.max(0, y); row < Math.min(this.height, y + size); row += 1) {
      for (let at = Math.max(0, x); at < Math.min(this.width, x + size); at += 1) {
        const i = row * this.width + at;
        this.pixels[i] = alpha >= 1 ? colour : mixed(this.pixels[i]!, colour, alpha);
      }
    }
  }

  /** A glyph in one colour, its middle at (x, y). */
  stamp(glyph: Glyph, x: number, y: number, colour: number): void {
    const { size, alpha } = glyph;
    const [left, top] = [Math.round(x - size / 2), Math.round(y - size / 2)];
    for (let row = 0; row < size; row += 1) {
      for (let at = 0; at < size; at += 1) {
        const a = alpha[row * size + at]!;
        if (a > 8 && left + at >= 0 && left + at < this.width && top + row >= 0 && top + row < this.height) {
          const i = (top + row) * this.width + left + at;
          this.pixels[i] = mixed(this.pixels[i]!, colour, a / 255);
        }
      }
    }
  }

  put(g: CanvasRenderingContext2D): void {
    g.putImageData(this.image, 0, 0);
  }
}

export interface Glyph {
  size: number;
  alpha: Uint8Array;
}

const glyphs = new Map<string, Glyph>();

/** A character drawn once at this size, as opacities. */
export function glyph(character: string, pixels: number): Glyph {
  const key = `${character} ${pixels}`;
  let made = glyphs.get(key);
  if (!made) {
    const size = Math.ceil(pixels * 1.5);
    const g = new OffscreenCanvas(size, size).getContext('2d', { willReadFrequently: true })!;
    g.font = `${pixels}px system-ui, sans-serif`;
    g.textAlign = 'center';
    g.textBaseline = 'middle';
    g.fillText(character, size / 2, size / 2);
    const { data } = g.getImageData(0, 0, size, size);
    glyphs.set(key, made = { size, alpha: Uint8Array.from({ length: size * size }, (_, i) => data[4 * i + 3]!) });
  }
  return made;
}

function mixed(under: number, over: number, alpha: number): number {
  const channel = (shift: number): number => Math.round(((under >>> shift) & 255) * (1 - alpha) + ((over >>> shift) & 255) * alpha) << shift;
  return (channel(0) | channel(8) | channel(16) | 0xff000000) >>> 0;
}

const known = new Map<string, { colour: number; alpha: number }>();

/** A colour as the style sheet has it: #rgb, #rrggbb, either with alpha, rgb() or rgba(). A pixel is the bytes red, green, blue, alpha. */
export function parsed(text: string): { colour: number; alpha: number } {
  let found = known.get(text);
  if (!found) {
    const [red, green, blue, alpha] = text.startsWith('#') ? fromHex(text.slice(1)) : (text.match(/[\d.]+/g) ?? []).map(Number);
    known.set(text, found = { colour: ((red ?? 0) | ((green ?? 0) << 8) | ((blue ?? 0) << 16) | 0xff000000) >>> 0, alpha: alpha ?? 1 });
  }
  return found;
}

function fromHex(digits: string): number[] {
  const long = digits.length > 4 ? digits : [...digits].map((d) => d + d).join('');
  const bytes = (long.match(/../g) ?? []).map((h) => parseInt(h, 16));
  return bytes.map((v, i) => (i === 3 ? v / 255 : v));
}

export function packed(text: string): number {
  return parsed(text).colour;
}
