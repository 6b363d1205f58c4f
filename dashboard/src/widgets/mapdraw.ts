// Draws the blocks of a plan. The ground layer goes into a canvas larger than the view and is blitted while panning.
import { css, GLYPHS, ramp, stateColours, workerColour } from '../colours';
import { DONE, FAILED, QUARANTINED, RUNNING, WAITING, type TaskTable } from '../tasks';
import type { Plane } from './plane';
import { glyph, packed, parsed, type Raster } from './raster';

export type ColourBy = 'state' | 'psnr' | 'splats' | 'speed' | 'worker';
/** A level, or -1: the finest block at each place. */
export type Level = number;

export interface Look {
  by: ColourBy;
  level: Level;
  cameras: boolean;
  points: boolean;
}

/** Least and greatest of the coloured number, for the ramp and its legend. */
export function extent(t: TaskTable, look: Look): [number, number] {
  let [low, high] = [Infinity, -Infinity];
  const column = look.by === 'psnr' ? t.psnr : look.by === 'speed' ? t.speed : t.splats;
  for (let i = 0; i < t.blocks; i += 1) {
    const v = column[i]!;
    if (!(v > 0) || (look.level >= 0 && t.plan.blocks.level[i] !== look.level)) continue;
    if (v < low) low = v;
    if (v > high) high = v;
  }
  return low <= high ? [low, high] : [0, 1];
}

/** Draws into `g`, whose size is the raster's. `plane` is in its pixels; `ratio` of them make a CSS pixel. */
export function drawGround(g: CanvasRenderingContext2D, raster: Raster, plane: Plane, ratio: number, t: TaskTable, look: Look, places: Places): void {
  raster.clear(css('map'));
  const byLevel = order(t);
  const colour = colours(t, look);
  const marked: { tasks: number[]; edge: number }[] = [];
  for (let level = 0; level < byLevel.length; level += 1) {
    if (look.level >= 0 && level !== look.level) continue;
    const edge = t.edge(level);
    marked.push({ edge, tasks: drawLevel(raster, plane, t, look, byLevel[level]!, edge, colour, places) });
  }
  if (look.points) dots(raster, plane, t.plan.points, css('point'), Math.round(ratio));
  if (look.cameras) {
    const { x, y, test } = t.plan.cameras;
    dots(raster, plane, { x, y }, css('camera'), Math.round(2 * ratio), (i) => !test[i]);
    dots(raster, plane, { x, y }, css('camera-test'), Math.round(2 * ratio), (i) => !!test[i]);
  }
  for (const { tasks, edge } of marked) glyphs(raster, plane, ratio, t, look, tasks, edge);
  raster.put(g);
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  for (const { tasks, edge } of marked) if (edge * plane.scale > LABELLED * ratio) labels(g, plane, ratio, t, look, tasks, edge);
}

/** Fills the cells of one level; returns those that have room for a glyph and are not covered. */
function drawLevel(raster: Raster, plane: Plane, t: TaskTable, look: Look, tasks: Uint32Array, edge: number, colour: (i: number) => string, places: Places): number[] {
  const size = edge * plane.scale;
  const { x: rx, y: ry } = t.plan.root;
  const { x: bx, y: by } = t.plan.blocks;
  const gap = size > 7 ? 1 : 0;
  const [gaps, rests] = [packed(css('map')), packed(css('running-rest'))];
  const visible: number[] = [];
  for (const i of tasks) {
    const left = Math.round(plane.px(rx + bx[i]! * edge));
    const top = Math.round(plane.py(ry + (by[i]! + 1) * edge));
    if (left > plane.width || top > plane.height || left + size < 0 || top + size < 0) continue;
    const fill = colour(i);
    if (fill === '' || places.hidden(i, look.level)) continue;
    const state = t.state[i]!;
    // From rounded edge to rounded edge, so that neighbours neither part nor overlap.
    const w = Math.round(plane.px(rx + (bx[i]! + 1) * edge)) - left;
    const h = Math.round(plane.py(ry + by[i]! * edge)) - top;
    if (gap) raster.rect(left, top, w, h, gaps);
    const share = look.by === 'state' && state === RUNNING && size > 8 ? t.progress[i]! / 1000 : 1;
    const rest = Math.round((1 - share) * (h - gap));
    raster.rect(left, top + rest, w - gap, h - gap - rest, packed(fill));
    if (rest > 0) raster.rect(left, top, w - gap, rest, rests);
    if ((state === FAILED || state === QUARANTINED) && size > 3) raster.hatch(left, top, w - gap, h - gap, state === QUARANTINED);
    if (size >= 15 && places.onTop(i, look.level)) visible.push(i);
  }
  return visible;
}

function glyphs(raster: Raster, plane: Plane, ratio: number, t: TaskTable, look: Look, tasks: number[], edge: number): void {
  const size = (edge * plane.scale) / ratio;
  const pixels = Math.round(Math.min(15, Math.max(9, size * 0.36)) * ratio);
  const [onLight, white] = [packed(css('on-light')), packed('#ffffff')];
  for (const i of tasks) {
    const state = t.state[i]!;
    if (look.by !== 'state' && state !== FAILED && state !== QUARANTINED) continue;
    const x = plane.px(t.plan.root.x + (t.plan.blocks.x[i]! + 0.5) * edge);
    const y = plane.py(t.plan.root.y + (t.plan.blocks.y[i]! + 0.5) * edge);
    raster.stamp(glyph(GLYPHS[state]!, pixels), x, size > LABELLED ? y - 7 * ratio : y, look.by === 'state' && onRest(t, i) ? onLight : white);
  }
}

/** Whether the middle of the cell is pale: waiting, ready, or running and not yet half filled. */
function onRest(t: TaskTable, i: number): boolean {
  return t.state[i]! < RUNNING || (t.state[i] === RUNNING && t.progress[i]! < 450);
}

/** Edge in CSS pixels from which a cell has room for its number. */
const LABELLED = 46;

function labels(g: CanvasRenderingContext2D, plane: Plane, ratio: number, t: TaskTable, look: Look, tasks: number[], edge: number): void {
  g.textAlign = 'center';
  g.textBaseline = 'middle';
  g.font = '10px system-ui, sans-serif';
  for (const i of tasks) {
    const text = label(t, look, i);
    if (text === '') continue;
    const x = plane.px(t.plan.root.x + (t.plan.blocks.x[i]! + 0.5) * edge) / ratio;
    const y = plane.py(t.plan.root.y + (t.plan.blocks.y[i]! + 0.5) * edge) / ratio;
    if (look.by !== 'state') { g.fillStyle = 'rgba(0,0,0,.45)'; g.fillRect(x - 20, y + 1, 40, 13); }
    g.fillStyle = look.by === 'state' && onRest(t, i) ? css('on-light') : '#fff';
    g.fillText(text, x, y + 8);
  }
}

function label(t: TaskTable, look: Look, i: number): string {
  if (look.by === 'worker') return t.worker[i]!;
  if (look.by === 'speed') return t.speed[i]! > 0 ? `${t.speed[i]!.toFixed(0)}/s` : '';
  if (look.by === 'splats') return t.splats[i]! > 0 ? `${(t.splats[i]! / 1000).toFixed(1)} k` : '';
  if (look.by === 'state' && t.state[i] === RUNNING) return `${Math.floor(t.progress[i]! / 10)} %`;
  return t.psnr[i]! > 0 ? t.psnr[i]!.toFixed(1) : '';
}

/** The colour of a task, or '' where it has nothing to show and the coarser block should stay visible. */
function colours(t: TaskTable, look: Look): (i: number) => string {
  const states = stateColours();
  if (look.by === 'state') return (i) => states[t.state[i]!]!;
  const none = look.level >= 0 ? css('unknown') : '';
  if (look.by === 'worker') {
    const seen = new Map<string, string>();
    return (i) => {
      const name = t.worker[i]!;
      if (name === '') return none;
      let c = seen.get(name);
      if (!c) seen.set(name, c = workerColour(name));
      return c;
    };
  }
  const column = look.by === 'psnr' ? t.psnr : look.by === 'speed' ? t.speed : t.splats;
  const [low, high] = extent(t, look);
  const steps = Array.from({ length: 33 }, (_, k) => ramp(k / 32));
  return (i) => (column[i]! > 0 ? steps[Math.round(((column[i]! - low) / (high - low || 1)) * 32)]! : none);
}

const levelsOf = new WeakMap<TaskTable, Uint32Array[]>();
function order(t: TaskTable): Uint32Array[] {
  let known = levelsOf.get(t);
  if (!known) {
    const lists: number[][] = Array.from({ length: t.levels }, () => []);
    t.plan.blocks.level.forEach((l, i) => (lists[l] ??= []).push(i));
    levelsOf.set(t, known = lists.map((l) => Uint32Array.from(l)));
  }
  return known;
}

function dots(raster: Raster, plane: Plane, at: { x: number[]; y: number[] }, fill: string, size: number, pick?: (i: number) => boolean): void {
  const { colour, alpha } = parsed(fill);
  for (let i = 0; i < at.x.length; i += 1) {
    if (pick && !pick(i)) continue;
    raster.dot(Math.round(plane.px(at.x[i]!)), Math.round(plane.py(at.y[i]!)), size, colour, alpha);
  }
}

/** Finds blocks by place; built once a table. */
export class Places {
  private readonly at = new Map<number, number>();
  constructor(private readonly t: TaskTable) {
    const { level, x, y } = t.plan.blocks;
    for (let i = 0; i < level.length; i += 1) this.at.set(Places.key(level[i]!, x[i]!, y[i]!), i);
  }
  private static key(l: number, x: number, y: number): number { return (l * 2 ** 20 + x) * 2 ** 20 + y; }

  block(l: number, x: number, y: number): number | null { return this.at.get(Places.key(l, x, y)) ?? null; }

  /**
   * At the finest level a block that waits below one that is not done yet has nothing to tell: the one above shows what
   * holds it up (it runs, or it failed).
   */
  hidden(i: number, level: Level): boolean {
    if (level >= 0 || this.t.state[i] !== WAITING) return false;
    const { level: l, x, y } = this.t.plan.blocks;
    const parent = this.block(l[i]! - 1, x[i]! >> 1, y[i]! >> 1);
    return parent !== null && this.t.state[parent] !== DONE;
  }

  /** Whether no finer block lies over the middle of a quarter of this one. */
  onTop(i: number, level: Level): boolean {
    if (level >= 0) return true;
    const { root, blocks: b } = this.t.plan;
    const e = this.t.edge(b.level[i]!);
    const at = (u: number, v: number): boolean => this.find(root.x + (b.x[i]! + u) * e, root.y + (b.y[i]! + v) * e, level) === i;
    return at(0.25, 0.25) && at(0.75, 0.25) && at(0.25, 0.75) && at(0.75, 0.75);
  }

  /** The block that is on top at a place, or null. */
  find(x: number, y: number, level: Level): number | null {
    const { root } = this.t.plan;
    for (let l = level >= 0 ? level : this.t.levels - 1; l >= (level >= 0 ? level : 0); l -= 1) {
      const e = this.t.edge(l);
      const found = this.block(l, Math.floor((x - root.x) / e), Math.floor((y - root.y) / e));
      if (found !== null && !this.hidden(found, level)) return found;
    }
    return null;
  }
}

export function outline(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable, i: number, colour: string, width: number): void {
  const e = t.edge(t.plan.blocks.level[i]!);
  const left = plane.px(t.plan.root.x + t.plan.blocks.x[i]! * e);
  const top = plane.py(t.plan.root.y + (t.plan.blocks.y[i]! + 1) * e);
  g.strokeStyle = colour;
  g.lineWidth = width;
  g.strokeRect(left + 0.5, top + 0.5, e * plane.scale - 1, e * plane.scale - 1);
}

export function furniture(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable, text: (metres: number) => string): void {
  const bar = plane.bar(140);
  const [x, y] = [14, plane.height - 16];
  g.font = '11px system-ui, sans-serif';
  g.textBaseline = 'bottom';
  g.textAlign = 'left';
  const w = bar * plane.scale;
  g.fillStyle = css('map-label');
  g.fillRect(x - 6, y - 18, Math.max(w, g.measureText(text(bar)).width) + 12, 26);
  g.strokeStyle = g.fillStyle = css('text');
  g.lineWidth = 1.5;
  g.beginPath();
  g.moveTo(x, y - 3); g.lineTo(x, y + 2); g.lineTo(x + w, y + 2); g.lineTo(x + w, y - 3);
  g.stroke();
  g.fillText(text(bar), x, y - 3);
  if (!t.plan.north_up) return;
  const [nx, ny] = [plane.width - 24, plane.height - 20];
  g.fillStyle = css('map-label');
  g.fillRect(nx - 12, ny - 30, 24, 42);
  g.fillStyle = css('text');
  g.beginPath();
  g.moveTo(nx, ny - 26); g.lineTo(nx + 6, ny - 8); g.lineTo(nx, ny - 12); g.lineTo(nx - 6, ny - 8);
  g.fill();
  g.textAlign = 'center';
  g.fillText('N', nx, ny + 8);
}

