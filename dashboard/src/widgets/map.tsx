// The city map: blocks over cameras and sparse points. Pans by blitting a cached layer; draws only when something changed.
import { useEffect, useRef } from 'preact/hooks';
import { useSignal, type Signal } from '@preact/signals';
import { css } from '../colours';
import { fixed, count, metres, DASH } from '../format';
import { dark } from '../settings';
import { NAMES, RUNNING, version as liveVersion, type TaskTable } from '../tasks';
import { drawGround, furniture, outline, Places, type Look } from './mapdraw';
import { Plane } from './plane';
import { Raster } from './raster';

interface Props {
  table: TaskTable;
  version: number;
  look: Look;
  selection: Signal<Set<number>>;
  onOpen: (task: number) => void;
  small?: boolean;
}

const MARGIN = 0.5; // of the view, cached beyond each edge

export function CityMap({ table, version, look, selection, onOpen, small }: Props) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const map = useRef<Painter | null>(null);
  const hover = useSignal<{ task: number; x: number; y: number } | null>(null);
  const spoken = useSignal('');

  useEffect(() => {
    const painter = new Painter(canvas.current!, selection);
    map.current = painter;
    painter.onHover = (task, x, y) => { hover.value = task === null ? null : { task, x, y }; };
    painter.onFocus = (text) => { spoken.value = text; };
    return () => painter.close();
  }, [selection]);
  useEffect(() => { map.current!.onOpen = onOpen; });
  useEffect(() => { map.current!.show(table, look); }, [table, look.by, look.level, look.cameras, look.points]);
  useEffect(() => { map.current!.stale(); }, [version, dark.value]);
  useEffect(() => { map.current!.paint(); }, [selection.value]);

  const help = 'Arrow keys move over blocks, Enter opens one, space selects, plus and minus zoom, 0 shows all. The table below holds the same.';
  return (
    <div class={small ? 'map small' : 'map'}>
      <canvas ref={canvas} tabIndex={0} role="application" aria-label={`Map of ${table.blocks} blocks. ${help}`} />
      <div class="zoom" role="group" aria-label="Zoom">
        <button type="button" aria-label="Zoom in" onClick={() => map.current!.zoom(1.5)}>+</button>
        <button type="button" aria-label="Zoom out" onClick={() => map.current!.zoom(1 / 1.5)}>−</button>
        <button type="button" aria-label="Show all" onClick={() => map.current!.fit()}>▢</button>
      </div>
      {hover.value && <Tip table={table} {...hover.value} />}
      <div class="hidden" aria-live="polite">{spoken.value}</div>
    </div>
  );
}

function Tip({ table: t, task, x, y }: { table: TaskTable; task: number; x: number; y: number }) {
  void liveVersion.value;
  const b = t.plan.blocks;
  return (
    <div class="tip" style={{ left: `${x + 14}px`, top: `${y + 14}px` }}>
      <b>{t.name(task)}</b> {NAMES[t.state[task]!]}{t.state[task] === RUNNING ? ` ${Math.floor(t.progress[task]! / 10)} %` : ''}<br />
      {fixed(t.psnr[task], 2)} dB · {count(t.splats[task])} splats<br />
      step {Math.round((b.steps[task]! * t.progress[task]!) / 1000)} of {b.steps[task]} · {t.speed[task]! > 0 ? `${fixed(t.speed[task], 1)} steps/s` : DASH}<br />
      {t.worker[task] || 'no worker'}{t.attempt[task]! > 1 ? ` · attempt ${t.attempt[task]}` : ''} · {fixed(b.rho_metres[task]! * 100, 1)} cm a pixel
    </div>
  );
}

/** Owns the canvas: input, the cached layer, and when to draw. */
class Painter {
  onOpen: (task: number) => void = () => {};
  onHover: (task: number | null, x: number, y: number) => void = () => {};
  onFocus: (text: string) => void = () => {};
  private readonly g: CanvasRenderingContext2D;
  private readonly layer = document.createElement('canvas');
  private readonly plane = new Plane();
  private layerPlane: Plane | null = null;
  private raster: Raster | null = null;
  private table: TaskTable | null = null;
  private places: Places | null = null;
  private look: Look = { by: 'state', level: -1, cameras: true, points: true };
  private focus: number | null = null;
  private frame = 0;
  private frames = 0;
  private ratio = 1;
  private fitted = false;
  private box: [number, number, number, number] | null = null;
  private readonly stop = new AbortController();
  private readonly sizes: ResizeObserver;

  constructor(private readonly canvas: HTMLCanvasElement, private readonly selection: Signal<Set<number>>) {
    // Drawn by the CPU: thousands of small rectangles stall a software GPU and gain nothing on a real one.
    this.g = canvas.getContext('2d', { willReadFrequently: true })!;
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas);
    this.listen();
  }

  close(): void {
    this.sizes.disconnect();
    this.stop.abort();
    cancelAnimationFrame(this.frame);
  }

  show(table: TaskTable, look: Look): void {
    if (table.plan !== this.table?.plan) { this.fitted = false; this.places = new Places(table); this.focus = null; }
    this.table = table;
    this.look = look;
    this.stale();
  }

  stale(): void { this.layerPlane = null; this.paint(); }
  paint(): void { this.frame ||= requestAnimationFrame(() => { this.frame = 0; this.draw(); }); }
  zoom(factor: number, x?: number, y?: number): void { this.plane.zoom(factor, x, y); this.paint(); }
  fit(): void { if (this.table) { this.plane.fit(this.table.plan.root, Math.min(28, this.plane.height * 0.06)); this.paint(); } }

  private resize(): void {
    const { clientWidth, clientHeight } = this.canvas;
    this.ratio = Math.min(2, devicePixelRatio || 1);
    this.canvas.width = Math.max(1, Math.round(clientWidth * this.ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * this.ratio));
    this.plane.width = clientWidth;
    this.plane.height = clientHeight;
    this.fitted = false;
    this.layerPlane = null;
    // At once: a canvas is empty after it has changed its size.
    this.draw();
  }

  private draw(): void {
    const { g, plane, table } = this;
    if (!table || plane.width < 2) return;
    if (!this.fitted) { this.fit(); this.fitted = true; }
    const l = this.layerPlane;
    // The layer holds while it covers the view at the same scale.
    const covers = l && l.scale === plane.scale && Math.abs((plane.x - l.x) * l.scale) <= MARGIN * plane.width && Math.abs((plane.y - l.y) * l.scale) <= MARGIN * plane.height;
    if (!covers) this.drawLayer();
    const at = this.layerPlane!;
    g.setTransform(1, 0, 0, 1, 0, 0);
    const dx = (at.x - plane.x) * plane.scale - (at.width - plane.width) / 2;
    const dy = (plane.y - at.y) * plane.scale - (at.height - plane.height) / 2;
    g.drawImage(this.layer, Math.round(dx * this.ratio), Math.round(dy * this.ratio));
    g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    for (const task of this.selection.peek()) outline(g, plane, table, task, css('select'), 2.5);
    if (this.focus !== null) outline(g, plane, table, this.focus, css('text'), 2);
    if (this.box) {
      const [x0, y0, x1, y1] = this.box;
      g.strokeStyle = css('select');
      g.lineWidth = 1.5;
      g.setLineDash([5, 4]);
      g.strokeRect(x0, y0, x1 - x0, y1 - y0);
      g.setLineDash([]);
    }
    furniture(g, plane, table, metres);
    this.frames += 1;
    this.canvas.dataset['frames'] = String(this.frames);
  }

  private drawLayer(): void {
    const layer = this.plane.copy();
    layer.width = Math.ceil(this.plane.width * (1 + 2 * MARGIN));
    layer.height = Math.ceil(this.plane.height * (1 + 2 * MARGIN));
    const [w, h] = [Math.round(layer.width * this.ratio), Math.round(layer.height * this.ratio)];
    if (this.layer.width !== w || this.layer.height !== h) { this.layer.width = w; this.layer.height = h; }
    if (this.raster?.width !== w || this.raster.height !== h) this.raster = new Raster(w, h);
    const g = this.layer.getContext('2d', { alpha: false, willReadFrequently: true })!;
    const pixels = layer.copy();
    pixels.scale *= this.ratio;
    pixels.width = w;
    pixels.height = h;
    drawGround(g, this.raster, pixels, this.ratio, this.table!, this.look, this.places!);
    this.layerPlane = layer;
  }

  private find(e: PointerEvent | MouseEvent): number | null {
    return this.places?.find(this.plane.mx(e.offsetX), this.plane.my(e.offsetY), this.look.level) ?? null;
  }

  private listen(): void {
    const { canvas } = this;
    const options = { signal: this.stop.signal };
    let last = { x: 0, y: 0 };
    let from: { x: number; y: number; moved: boolean; box: boolean } | null = null;
    canvas.addEventListener('pointerdown', (e) => {
      canvas.setPointerCapture(e.pointerId);
      from = { x: e.offsetX, y: e.offsetY, moved: false, box: e.shiftKey };
      last = { x: e.offsetX, y: e.offsetY };
    }, options);
    canvas.addEventListener('pointermove', (e) => {
      if (!from) {
        this.onHover(this.find(e), e.offsetX, e.offsetY);
        return;
      }
      if (Math.abs(e.offsetX - from.x) + Math.abs(e.offsetY - from.y) > 3) from.moved = true;
      if (!from.moved) return;
      this.onHover(null, 0, 0);
      if (from.box) this.box = [from.x, from.y, e.offsetX, e.offsetY];
      else {
        this.plane.pan(e.offsetX - last.x, e.offsetY - last.y);
        last = { x: e.offsetX, y: e.offsetY };
      }
      this.paint();
    }, options);
    canvas.addEventListener('pointerup', (e) => {
      if (from?.box && this.box) this.selectBox(this.box, e.ctrlKey || e.metaKey);
      else if (from && !from.moved) this.select(this.find(e), e.ctrlKey || e.metaKey || e.shiftKey);
      from = null;
      this.box = null;
      this.paint();
    }, options);
    canvas.addEventListener('pointerleave', () => this.onHover(null, 0, 0), options);
    canvas.addEventListener('dblclick', (e) => { const t = this.find(e); if (t !== null) this.onOpen(t); }, options);
    canvas.addEventListener('wheel', (e) => { e.preventDefault(); this.zoom(Math.exp(-e.deltaY * 0.0015), e.offsetX, e.offsetY); }, { ...options, passive: false });
    canvas.addEventListener('keydown', (e) => { if (this.key(e)) e.preventDefault(); }, options);
  }

  private select(task: number | null, add: boolean): void {
    const next = new Set(add ? this.selection.peek() : []);
    if (task !== null && !next.delete(task)) next.add(task);
    this.focus = task;
    this.selection.value = next;
  }

  private selectBox([x0, y0, x1, y1]: [number, number, number, number], add: boolean): void {
    const t = this.table!;
    const next = new Set(add ? this.selection.peek() : []);
    const [left, right] = [this.plane.mx(Math.min(x0, x1)), this.plane.mx(Math.max(x0, x1))];
    const [low, high] = [this.plane.my(Math.max(y0, y1)), this.plane.my(Math.min(y0, y1))];
    const b = t.plan.blocks;
    for (let i = 0; i < t.blocks; i += 1) {
      const e = t.edge(b.level[i]!);
      const [cx, cy] = [t.plan.root.x + (b.x[i]! + 0.5) * e, t.plan.root.y + (b.y[i]! + 0.5) * e];
      if (cx >= left && cx <= right && cy >= low && cy <= high && this.places!.find(cx, cy, this.look.level) === i) next.add(i);
    }
    this.selection.value = next;
  }

  private key(e: KeyboardEvent): boolean {
    const arrows: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const way = arrows[e.key];
    if (way && e.shiftKey) { this.plane.pan(-60 * way[0], 60 * way[1]); this.paint(); return true; }
    if (way) { this.step(way); return true; }
    if (e.key === '+' || e.key === '=') { this.zoom(1.4); return true; }
    if (e.key === '-') { this.zoom(1 / 1.4); return true; }
    if (e.key === '0') { this.fit(); return true; }
    if (e.key === 'Enter' && this.focus !== null) { this.onOpen(this.focus); return true; }
    if (e.key === ' ') { this.select(this.focus, true); return true; }
    if (e.key === 'Escape') { this.selection.value = new Set(); return true; }
    return false;
  }

  /** Moves the focus to what lies beyond the focused block's edge. */
  private step([dx, dy]: [number, number]): void {
    const t = this.table;
    if (!t) return;
    const { root, blocks: b } = t.plan;
    let next: number | null = null;
    if (this.focus === null) next = this.places!.find(this.plane.x, this.plane.y, this.look.level) ?? 0;
    else {
      const e = t.edge(b.level[this.focus]!);
      let [x, y] = [root.x + (b.x[this.focus]! + 0.5) * e, root.y + (b.y[this.focus]! + 0.5) * e];
      for (let k = 0; k < 64 && next === null; k += 1) {
        x += dx * (k === 0 ? e * 0.5 + t.edge(t.levels - 1) * 0.5 : t.edge(t.levels - 1));
        y += dy * (k === 0 ? e * 0.5 + t.edge(t.levels - 1) * 0.5 : t.edge(t.levels - 1));
        next = this.places!.find(x, y, this.look.level);
      }
    }
    if (next === null) return;
    this.focus = next;
    const e = t.edge(b.level[next]!);
    const [px, py] = [this.plane.px(root.x + (b.x[next]! + 0.5) * e), this.plane.py(root.y + (b.y[next]! + 0.5) * e)];
    if (px < 20 || py < 20 || px > this.plane.width - 20 || py > this.plane.height - 20) this.plane.pan(this.plane.width / 2 - px, this.plane.height / 2 - py);
    this.onFocus(`${t.name(next)}, ${NAMES[t.state[next]!]}, ${fixed(t.psnr[next], 1)} decibel`);
    this.paint();
  }
}
