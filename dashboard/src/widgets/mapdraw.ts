// Draws the blocks of a plan. The ground layer goes into a canvas larger than the view and is blitted while panning.
import { css, GLYPHS, ramp, stateColours, workerColour } from '../colours';
import { FAILED, QUARANTINED, RUNNING, type TaskTable } from '../tasks';
import type { Plane } from './plane';

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

export function drawGround(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable, look: Look, places: Places): void {
  g.fillStyle = css('map');
  g.fillRect(0, 0, plane.width, plane.height);
  const byLevel = order(t);
  const colour = colours(t, look);
  for (let level = 0; level < byLevel.length; level += 1) {
    if (look.level >= 0 && level !== look.level) continue;
    drawLevel(g, plane, t, look, byLevel[level]!, t.edge(level), colour, places);
  }
  if (look.points) dots(g, plane, t.plan.points, css('point'), 1);
  if (look.cameras) cameras(g, plane, t);
}

function drawLevel(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable, look: Look, tasks: Uint32Array, edge: number, colour: (i: number) => string, places: Places): void {
  const size = edge * plane.scale;
  const { x: rx, y: ry } = t.plan.root;
  const { x: bx, y: by } = t.plan.blocks;
  // One path a colour: a fill of many rectangles costs little more than a fill of one.
  const paths = new Map<string, Path2D>();
  const hatched = new Map<number, Path2D>();
  const visible: number[] = [];
  const edges = new Path2D();
  for (const i of tasks) {
    const left = plane.px(rx + bx[i]! * edge);
    const top = plane.py(ry + (by[i]! + 1) * edge);
    if (left > plane.width || top > plane.height || left + size < 0 || top + size < 0) continue;
    const fill = colour(i);
    if (fill === '') continue;
    const state = t.state[i]!;
    let path = paths.get(fill);
    if (!path) paths.set(fill, path = new Path2D());
    const share = look.by === 'state' && state === RUNNING && size > 8 ? t.progress[i]! / 1000 : 1;
    path.rect(left, top + (1 - share) * size, size, share * size);
    if (share < 1) {
      const rest = css('running-rest');
      let back = paths.get(rest);
      if (!back) paths.set(rest, back = new Path2D());
      back.rect(left, top, size, (1 - share) * size);
    }
    if (size > 5) edges.rect(left, top, size, size);
    if ((state === FAILED || state === QUARANTINED) && size > 3) {
      let path2 = hatched.get(state);
      if (!path2) hatched.set(state, path2 = new Path2D());
      path2.rect(left, top, size, size);
    }
    if (size >= 15 && places.onTop(i, look.level)) visible.push(i);
  }
  for (const [fill, path] of paths) { g.fillStyle = fill; g.fill(path); }
  for (const [state, path] of hatched) { g.fillStyle = hatch(g, state === QUARANTINED); g.fill(path); }
  if (size > 5) { g.strokeStyle = css('map'); g.lineWidth = size > 30 ? 1.5 : 0.75; g.stroke(edges); }
  if (visible.length < 3000) glyphs(g, plane, t, look, visible, edge);
}

function glyphs(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable, look: Look, tasks: number[], edge: number): void {
  const size = edge * plane.scale;
  g.textAlign = 'center';
  g.textBaseline = 'middle';
  for (const i of tasks) {
    const state = t.state[i]!;
    const x = plane.px(t.plan.root.x + (t.plan.blocks.x[i]! + 0.5) * edge);
    const y = plane.py(t.plan.root.y + (t.plan.blocks.y[i]! + 0.5) * edge);
    const light = look.by === 'state' && (state === 0 || state === 1);
    g.fillStyle = light ? css('on-light') : '#fff';
    g.font = `${Math.min(15, Math.max(9, size * 0.36))}px system-ui, sans-serif`;
    if (look.by === 'state' || state === FAILED || state === QUARANTINED) g.fillText(GLYPHS[state]!, x, size > 46 ? y - 7 : y);
    if (size > 46) {
      const text = label(t, look, i);
      g.font = '10px system-ui, sans-serif';
      if (look.by !== 'state') { g.fillStyle = 'rgba(0,0,0,.45)'; g.fillRect(x - 20, y + 1, 40, 13); g.fillStyle = '#fff'; }
      g.fillText(text, x, y + 8);
    }
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
    const lists: number[][] = Array.from({ length: t.plan.levels }, () => []);
    t.plan.blocks.level.forEach((l, i) => (lists[l] ??= []).push(i));
    levelsOf.set(t, known = lists.map((l) => Uint32Array.from(l)));
  }
  return known;
}

const hatches = new Map<boolean, CanvasPattern>();
function hatch(g: CanvasRenderingContext2D, cross: boolean): CanvasPattern | string {
  let pattern = hatches.get(cross) ?? null;
  if (!pattern) {
    const tile = new OffscreenCanvas(6, 6);
    const p = tile.getContext('2d')!;
    p.strokeStyle = 'rgba(255,255,255,.55)';
    p.lineWidth = 1.2;
    p.beginPath();
    for (const k of [-6, 0, 6]) { p.moveTo(k, 6); p.lineTo(k + 6, 0); if (cross) { p.moveTo(k, 0); p.lineTo(k + 6, 6); } }
    p.stroke();
    pattern = g.createPattern(tile, 'repeat');
    if (pattern) hatches.set(cross, pattern);
  }
  return pattern ?? 'transparent';
}

function dots(g: CanvasRenderingContext2D, plane: Plane, at: { x: number[]; y: number[] }, fill: string, size: number): void {
  g.fillStyle = fill;
  g.beginPath();
  for (let i = 0; i < at.x.length; i += 1) {
    const x = plane.px(at.x[i]!);
    const y = plane.py(at.y[i]!);
    if (x >= 0 && y >= 0 && x <= plane.width && y <= plane.height) g.rect(x, y, size, size);
  }
  g.fill();
}

function cameras(g: CanvasRenderingContext2D, plane: Plane, t: TaskTable): void {
  const { x, y, test } = t.plan.cameras;
  for (const held of [0, 1]) {
    const pick = x.map((_, i) => i).filter((i) => (test[i] ? 1 : 0) === held);
    const size = plane.scale > 2 ? 3 : 2;
    dots(g, plane, { x: pick.map((i) => x[i]!), y: pick.map((i) => y[i]!) }, css(held ? 'camera-test' : 'camera'), size);
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

  /** Whether no finer block lies over the middle of this one. */
  onTop(i: number, level: Level): boolean {
    if (level >= 0) return true;
    const { root, blocks: b } = this.t.plan;
    const e = this.t.edge(b.level[i]!);
    const at = (u: number, v: number): boolean => this.find(root.x + (b.x[i]! + u) * e, root.y + (b.y[i]! + v) * e, level) === i;
    return at(0.25, 0.25) && at(0.75, 0.25) && at(0.25, 0.75) && at(0.75, 0.75);
  }

  /** The block that is on top at a place, or null. */
  find(x: number, y: number, level: Level): number | null {
    const { root, levels } = this.t.plan;
    for (let l = level >= 0 ? level : levels - 1; l >= (level >= 0 ? level : 0); l -= 1) {
      const e = this.t.edge(l);
      const found = this.block(l, Math.floor((x - root.x) / e), Math.floor((y - root.y) / e));
      if (found !== null) return found;
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

