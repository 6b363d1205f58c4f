// The 3D scene: the splats of the chosen cut, lines over them, and a loop that draws only when something changed.
import { SparkRenderer } from '@sparkjsdev/spark';
import * as THREE from 'three';
import type { ModelView, View } from '../api';
import { Blocks } from './blocks';
import { Boxes } from './boxes';
import { cut, error, square, tree, type Cut, type Node } from './cut';
import { Mover, type Frame } from './eye';

export interface Stats {
  shown: number;
  total: number;
  blocks: number;
  pending: number;
  held: number;
  megabytes: number;
  frames: number;
  format: string;
  errors: string[];
  labels: { text: string; task: number | null; left: number; top: number }[];
}

/** Splats of the first picture: what the first chunk of a file has. More is asked for once that is seen, twice as much each time. */
const FIRST_SPLATS = 20000;
const MORE_MILLIS = 500;
const FETCHERS = 3;
/** A first chunk with nothing to see does not hold the others up for longer. */
const PATIENCE_MILLIS = 3000;
const PAGE_SPLATS = 65536;
/** WebGL without a GPU takes a second for a sharp picture: the first one, and those while the eye moves, have half the resolution. */
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
const REST_MILLIS = 400;

/** Splats that Spark's pages hold, which it allocates at once: all nodes of a finished model, which are fewer than twice its splats, or else its own default. */
function pagedSplats(model: ModelView): number {
  const most = 256;
  if (model.blocks.some((b) => b.artefact === null)) return most * PAGE_SPLATS;
  return Math.min(most, model.blocks.reduce((pages, b) => pages + 1 + Math.ceil((2 * b.splats) / PAGE_SPLATS), 0)) * PAGE_SPLATS;
}

export interface Look { budget: number; tint: boolean; outlines: boolean; seams: boolean; ghosts: boolean }

export class Stage {
  readonly mover: Mover;
  onStats: (s: Stats) => void = () => {};
  private readonly renderer: THREE.WebGLRenderer;
  private readonly spark: SparkRenderer;
  private readonly scene = new THREE.Scene();
  private readonly blocks: Blocks;
  private readonly boxes: Boxes;
  private readonly sizes: ResizeObserver;
  private readonly network: PerformanceObserver;
  private nodes: Node[];
  private now: Cut = { masks: new Map(), splats: 0, held: 0 };
  private dirty = true;
  private moved = true;
  private frame = 0;
  private last = 0;
  private cutAt = 0;
  private frameTimes: number[] = [];
  private bytes = 0;

  constructor(private readonly canvas: HTMLCanvasElement, job: number, private model: ModelView, private look: Look, format: 'rad' | 'spz' | null) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: 'high-performance' });
    this.renderer.setPixelRatio(this.ratio);
    const gl = this.renderer.getContext();
    this.software = SOFTWARE.test(String(gl.getParameter(gl.getExtension('WEBGL_debug_renderer_info')?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER)));
    this.renderer.setClearColor(0x101418);
    // Trained with the anti-aliasing filter: compensated blur. Otherwise the plain one, as the trainer draws.
    const blur = model.antialiased ? { preBlurAmount: 0, blurAmount: 0.3 } : { preBlurAmount: 0.3, blurAmount: 0 };
    // What is outside the picture counts for little; `plat eval --budget` chooses nodes by the same weights.
    const around = { coneFov0: 90, coneFov: 150, coneFoveate: 0.1, behindFoveate: 0.05 };
    this.spark = new SparkRenderer({ renderer: this.renderer, lodSplatCount: Math.min(FIRST_SPLATS, look.budget), numLodFetchers: 1, maxPagedSplats: pagedSplats(model), ...blur, ...around, onDirty: () => { this.dirty = true; } });
    this.nodes = tree(model.blocks);
    this.blocks = new Blocks(job, model, format, () => { this.dirty = true; this.lines(); });
    void this.blocks.backdrop().catch(() => { /* the city is drawn without its sky */ });
    this.boxes = new Boxes(model);
    this.scene.add(this.spark, this.blocks.group, this.boxes.group);
    this.mover = new Mover(canvas, model);
    this.mover.orbit.addEventListener('change', () => { this.moved = true; });
    this.sizes = new ResizeObserver(() => this.resize());
    this.sizes.observe(canvas);
    this.network = new PerformanceObserver((list) => {
      for (const e of list.getEntries() as PerformanceResourceTiming[]) if (e.name.includes('/blocks/')) this.bytes += e.encodedBodySize || e.transferSize;
    });
    this.network.observe({ type: 'resource' });
    this.resize();
    this.frame = requestAnimationFrame((t) => this.loop(t));
  }

  close(): void {
    cancelAnimationFrame(this.frame);
    this.sizes.disconnect();
    this.network.disconnect();
    this.mover.close();
    this.blocks.close();
    this.spark.dispose();
    this.renderer.dispose();
  }

  setLook(look: Look): void {
    if (look.tint !== this.look.tint) this.blocks.retint(look.tint);
    this.look = look;
    this.spark.lodSplatCount = Math.min(this.allowed, look.budget);
    this.moved = true;
    this.choose();
  }

  /** Looks through another stage's camera: the two sides of a wipe. */
  follow(lead: Stage): void { this.lead = lead; }

  private lead: Stage | null = null;
  private copyLead(): void {
    const [from, to] = [this.lead!.mover.camera, this.mover.camera];
    // Each stage is about the centre of its own model.
    const [theirs, own] = [new THREE.Vector3(...this.lead!.model.centre), new THREE.Vector3(...this.model.centre)];
    const at = from.position.clone().add(theirs).sub(own);
    if (at.equals(to.position) && from.quaternion.equals(to.quaternion) && from.projectionMatrix.equals(to.projectionMatrix)) return;
    to.copy(from, false);
    to.position.copy(at);
    this.moved = true;
  }

  /** Blocks have finished since: draws them without moving the eye. */
  setModel(model: ModelView): void {
    this.model = { ...model, centre: this.model.centre };
    this.nodes = tree(model.blocks);
    this.choose();
  }

  capture(view: View): Frame {
    const frame = this.mover.capture(view);
    this.moved = true;
    return frame;
  }

  goTo(block: string): void {
    const n = this.nodes.find((m) => m.block.block === block);
    if (!n) return;
    const s = square(n, this.model.root);
    this.mover.look(s.x + s.edge / 2 - this.model.centre[0], s.y + s.edge / 2 - this.model.centre[1], s.edge);
    this.moved = true;
  }

  redraw(): void { this.moved = true; }

  /** What is drawn now, as a data URL. WebGL keeps no picture, so it is drawn and read in one go. */
  picture(width: number, height: number): string {
    this.setCoarse(false);
    this.renderer.render(this.scene, this.mover.camera);
    const copy = Object.assign(document.createElement('canvas'), { width, height });
    copy.getContext('2d')!.drawImage(this.canvas, 0, 0, width, height);
    return copy.toDataURL('image/png');
  }

  private choose(): void {
    const eye = this.mover.eye();
    this.now = cut(this.nodes, this.model.root, eye, this.look.budget);
    this.blocks.show(this.now, (n) => error(n.parent ?? n, this.model.root, eye));
    this.lines();
    this.dirty = true;
  }

  private lines(): void {
    this.boxes.show(this.blocks.shown, this.nodes, this.look);
    this.dirty = true;
  }

  private loop(time: number): void {
    this.frame = requestAnimationFrame((t) => this.loop(t));
    if (document.hidden) return;
    if (this.mover.step(Math.min(0.1, (time - this.last) / 1000))) this.moved = true;
    this.last = time;
    if (this.lead) this.copyLead();
    if (this.moved) this.movedAt = time;
    if (this.moved && time - this.cutAt > 400) {
      this.moved = false;
      this.cutAt = time;
      this.choose();
    }
    // Spark takes chunks that have come only while it draws, and does not say that one has come.
    const came = (this.spark.pager?.lodTreeUpdates.length ?? 0) > 0;
    if (came && this.cameAt === 0) this.cameAt = time;
    if (this.moved || this.allowMore(time) || came) this.dirty = true;
    if (!this.finished()) { this.tell(time); return; }
    this.setCoarse(this.software && (this.drawn === 0 || time - this.movedAt < REST_MILLIS));
    if (!this.dirty) { this.tell(time); return; }
    this.dirty = false;
    this.blocks.warm();
    this.renderer.render(this.scene, this.mover.camera);
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.drawing = this.spark.activeSplats;
    gl.flush();
    this.frameTimes.push(time);
    this.tell(time, true);
  }

  /** Whether the GPU has finished the frame before. On a slow one, frames must not pile up in its queue. */
  private finished(): boolean {
    if (!this.fence) return true;
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    if (gl.clientWaitSync(this.fence, 0, 0) === gl.TIMEOUT_EXPIRED) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    const before = this.drawn;
    this.drawn = Math.max(0, this.drawing - this.blocks.skySplats);
    if (before === 0 && this.drawn > 0) {
      this.toldAt = 0; // the first picture is told at once
      this.movedAt = performance.now(); // the sky comes to it before it is sharp
      this.blocks.showSky();
    }
    return true;
  }

  private readonly ratio = Math.min(1.5, devicePixelRatio || 1);
  private readonly software: boolean;
  private coarse = false;
  private movedAt = 0;
  /** Half the resolution, with the same splats. */
  private setCoarse(coarse: boolean): void {
    if (coarse === this.coarse) return;
    this.coarse = coarse;
    this.renderer.setPixelRatio(coarse ? this.ratio / 2 : this.ratio);
    this.spark.lodRenderScale = coarse ? 0.5 : 1;
    this.dirty = true;
  }

  /** Splats of blocks in the frame that the GPU has finished last, and those with the sky's in the one that it draws now. */
  private drawn = 0;
  private drawing = 0;

  /** Paged blocks share this many splats. Asking for all at once would bring megabytes before anything is seen. */
  private allowed = FIRST_SPLATS;
  private allowedAt = 0;
  private cameAt = 0;
  /** Whether more is allowed than at the frame before. */
  private allowMore(time: number): boolean {
    const waits = this.drawn === 0 && (this.cameAt === 0 || time - this.cameAt < PATIENCE_MILLIS);
    // One chunk until something is seen: a second would share the line with the first, or the cores with its picture.
    this.fetchers(this.cameAt === 0 ? 1 : waits ? 0 : FETCHERS);
    if (waits || this.allowed >= this.look.budget) return false;
    if (this.allowedAt === 0) this.allowedAt = time;
    if (time - this.allowedAt < MORE_MILLIS) return false;
    this.allowedAt = time;
    this.allowed *= 2;
    this.spark.lodSplatCount = Math.min(this.allowed, this.look.budget);
    return true;
  }

  private fetchers(most: number): void {
    const pager = this.spark.pager;
    if (!pager || pager.numFetchers === most) return;
    pager.numFetchers = most;
    pager.driveFetchers(); // Spark would look again only once the eye has moved
  }

  private fence: WebGLSync | null = null;
  private toldAt = 0;
  private tell(time: number, force = false): void {
    if (time - this.toldAt < (force ? 200 : 500)) return;
    this.toldAt = time;
    this.frameTimes = this.frameTimes.filter((t) => time - t < 2000);
    this.onStats({
      shown: this.drawn,
      total: this.nodes.reduce((n, m) => n + (m.block.artefact !== null && m.children.every((c) => !c || c.block.artefact === null) ? m.block.splats : 0), 0),
      blocks: this.blocks.shown.size, pending: this.blocks.pending, held: this.now.held, megabytes: this.bytes / 1e6,
      frames: this.frameTimes.length / 2, format: this.blocks.kind, errors: this.blocks.errors, labels: this.labels(),
    });
  }

  /** The nearest labels in CSS pixels. */
  private labels(): Stats['labels'] {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const eye = this.mover.camera.position;
    const near = [...this.boxes.labels].sort((a, b) => a.at.distanceToSquared(eye) - b.at.distanceToSquared(eye));
    const out: Stats['labels'] = [];
    for (const { text, task, at } of near) {
      const p = at.clone().project(this.mover.camera);
      const [left, top] = [((p.x + 1) / 2) * w, ((1 - p.y) / 2) * h];
      if (p.z > 1 || left < 0 || top < 0 || left > w || top > h || out.some((o) => Math.abs(o.left - left) < 90 && Math.abs(o.top - top) < 18)) continue;
      out.push({ text, task, left, top });
      if (out.length === 30) break;
    }
    return out;
  }

  private resize(): void {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    if (w === 0 || h === 0) return;
    this.renderer.setSize(w, h, false);
    this.mover.resize(w, h);
    this.moved = true;
  }
}
