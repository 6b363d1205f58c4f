// The map's view of the ground: local metres to pixels and back. y grows to the north, up on the map.
import type { Square } from '../api';

export class Plane {
  x = 0; // metres at the centre of the picture
  y = 0;
  scale = 1; // pixels per metre
  width = 1; // pixels
  height = 1;

  px(x: number): number { return (x - this.x) * this.scale + this.width / 2; }
  py(y: number): number { return (this.y - y) * this.scale + this.height / 2; }
  mx(px: number): number { return (px - this.width / 2) / this.scale + this.x; }
  my(py: number): number { return this.y - (py - this.height / 2) / this.scale; }

  fit(s: Square, margin = 24): void {
    this.x = s.x + s.edge / 2;
    this.y = s.y + s.edge / 2;
    this.scale = Math.max(1e-6, (Math.min(this.width, this.height) - 2 * margin) / s.edge);
  }

  pan(dx: number, dy: number): void {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }

  /** Zooms so that the ground under the pixel stays under it. */
  zoom(factor: number, px = this.width / 2, py = this.height / 2): void {
    const [x, y] = [this.mx(px), this.my(py)];
    this.scale = Math.max(1e-4, Math.min(1e4, this.scale * factor));
    this.x += x - this.mx(px);
    this.y += y - this.my(py);
  }

  copy(): Plane {
    return Object.assign(new Plane(), this);
  }

  /** A round length for the scale bar, at most `pixels` wide. */
  bar(pixels: number): number {
    const most = pixels / this.scale;
    const power = 10 ** Math.floor(Math.log10(most));
    return [5, 2, 1].map((k) => k * power).find((m) => m <= most) ?? power;
  }
}
