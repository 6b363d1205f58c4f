// The splats of blocks: loading them a few at a time, hiding the quarters that finer blocks draw, tinting by level.
import { dyno, PagedSplats, SplatFileType, SplatMesh } from '@sparkjsdev/spark';
import * as THREE from 'three';
import type { ModelView } from '../api';
import { blockUrl, takeFirst } from '../first';
import { square, type Cut, type Node } from './cut';

const LOADS_AT_ONCE = 3;
/** Blocks that are no longer wanted stay so long, in case the eye turns back. */
const KEPT = 48;
const SETTLE_MILLIS = 1500;
const TINTS = ['#ffffff', '#8fd0ff', '#7fe0b0', '#ffe27a', '#ffb07a', '#ff8fb8', '#d6a0ff', '#a0b0ff', '#c0ffc0', '#ffd0d0'];

interface Held {
  mesh: SplatMesh | null; // null while it loads
  mask: dyno.DynoInt<string>;
  bytes: number;
  error: string;
  used: number;
  /** Paged splats come some time after their file is open; until then the coarser block stays under them. */
  settled: 'no' | 'soon' | 'yes';
}

export class Blocks {
  readonly group = new THREE.Group();
  /** The drawn blocks, each with the quarters (bits) that its children draw. */
  readonly shown = new Map<Node, number>();
  /** From the files' axes to those of the ground plane. */
  private readonly turning = new THREE.Quaternion();
  /** SPZ's own axes point up and back where those of the other files point down and ahead: half a turn about x. */
  private readonly turningSpz = new THREE.Quaternion();
  tint = false;
  private format: 'rad' | 'spz' | null;
  private probe: Promise<'rad' | 'spz'> | null = null;
  private readonly held = new Map<string, Held>();
  private cut: Cut = { masks: new Map(), splats: 0, held: 0 };
  private loading = 0;
  private turn = 0;
  private closed = false;
  private sky: SplatMesh | null = null;
  private queue: Node[] = [];

  constructor(private readonly job: number, private readonly model: ModelView, format: 'rad' | 'spz' | null, private readonly changed: () => void) {
    if (model.turn) this.turning.set(...model.turn);
    this.turningSpz.copy(this.turning).multiply(new THREE.Quaternion(1, 0, 0, 0));
    const told = model.formats;
    this.format = format ?? (told ? (told.includes('rad') ? 'rad' : 'spz') : null);
  }

  /** Sky and far background of the root: never handed on, always drawn. */
  async backdrop(): Promise<void> {
    if (!this.model.blocks.some((b) => b.backdrop)) return;
    const reply = await fetch(`/api/jobs/${this.job}/backdrop.spz`);
    if (reply.status !== 200 || this.closed) return; // 204: there is none
    const mesh = new SplatMesh({ fileBytes: await reply.arrayBuffer(), fileType: SplatFileType.SPZ });
    await mesh.initialized;
    if (this.closed) { mesh.dispose(); return; }
    mesh.quaternion.copy(this.turningSpz);
    mesh.visible = this.skyWanted;
    this.group.add(mesh);
    this.sky = mesh;
    this.changed();
  }

  /** The sky is drawn once the city is: it fills the picture, and a slow GPU would draw it again and again until then. */
  private skyWanted = false;
  showSky(): void {
    this.skyWanted = true;
    if (this.sky) this.sky.visible = true;
    this.changed();
  }

  /** Splats of sky among those that are drawn. */
  get skySplats(): number { return this.sky?.visible ? this.sky.numSplats : 0; }

  /** Lets Spark compile the program of paged blocks while their splats are on the way: it does so at the first splat, and the empty page has one that is not drawn. */
  warm(): void {
    for (const { mesh } of this.held.values()) {
      const splats = mesh?.paged;
      if (splats?.pager && !splats.splatEncoding && splats.numSplats === 0) splats.numSplats = splats.dynoNumSplats.value = 1;
    }
  }

  get pending(): number { return this.queue.length + this.loading; }
  get errors(): string[] { return [...new Set([...this.held.values()].map((h) => h.error).filter(Boolean))]; }
  get kind(): string { return this.format ?? ''; }

  /** Draws this cut, as far as it is loaded; `order` says what to load first. */
  show(cut: Cut, order: (n: Node) => number): void {
    this.cut = cut;
    this.turn += 1;
    const missing = [...cut.masks.keys()].filter((n) => !this.held.has(n.block.artefact!));
    this.queue = missing.sort((a, b) => order(b) - order(a));
    // Something coarse at once: the coarsest finished blocks come before all others.
    const coarse = [...cut.masks.keys()].map(top).filter((n) => !this.held.has(n.block.artefact!));
    this.queue.unshift(...new Set(coarse));
    this.arrange();
    this.next();
  }

  close(): void {
    this.closed = true;
    for (const h of this.held.values()) h.mesh?.dispose();
    this.sky?.dispose();
  }

  private next(): void {
    while (this.loading < LOADS_AT_ONCE && this.queue.length > 0) {
      const n = this.queue.shift()!;
      const key = n.block.artefact!;
      if (this.held.has(key)) continue;
      const held: Held = { mesh: null, mask: new dyno.DynoInt({ value: 0 }), bytes: 0, error: '', used: this.turn, settled: 'no' };
      this.held.set(key, held);
      this.loading += 1;
      this.load(n, held)
        .catch((e: Error) => { held.error = `${n.block.block}: ${e.message}`; })
        .finally(() => {
          this.loading -= 1;
          if (this.closed) { held.mesh?.dispose(); return; }
          this.arrange();
          this.changed();
          this.next();
        });
    }
  }

  private async load(n: Node, held: Held): Promise<void> {
    const url = blockUrl(this.job, n.block);
    // The server says once whether it has the paged format; SPZ holds the same splats in one piece.
    this.format ??= await (this.probe ??= hasRad(`${url}.rad`));
    const objectModifier = this.quarters(n, held.mask);
    let mesh: SplatMesh;
    if (this.format === 'rad') {
      mesh = new SplatMesh({ paged: paged(`${url}.rad`, this.model.sh_degree), objectModifier });
    } else {
      const reply = await fetch(`${url}.spz`);
      if (!reply.ok) throw new Error(`${url}.spz: the server answered ${reply.status}`);
      const fileBytes = await reply.arrayBuffer();
      held.bytes = fileBytes.byteLength;
      mesh = new SplatMesh({ fileBytes, fileType: SplatFileType.SPZ, objectModifier });
    }
    await mesh.initialized;
    held.mesh = mesh;
    if (this.format === 'spz') held.settled = 'yes';
    mesh.visible = false;
    mesh.quaternion.copy(this.format === 'rad' ? this.turning : this.turningSpz);
    mesh.position.set(...origin(n));
    this.group.add(mesh);
  }

  /** Switches off splats whose centre lies in a quarter that a child draws. Centres are on the file's axes, about the block's origin. */
  private quarters(n: Node, mask: dyno.DynoInt<string>) {
    const s = square(n, this.model.root);
    const [x, y] = origin(n);
    const { centre } = this.model;
    const middle = new THREE.Vector2(s.x + s.edge / 2 - centre[0] - x, s.y + s.edge / 2 - centre[1] - y);
    const back = (this.format === 'rad' ? this.turning : this.turningSpz).clone().invert();
    const [east, north] = [new THREE.Vector3(1, 0, 0), new THREE.Vector3(0, 1, 0)].map((axis) => axis.applyQuaternion(back));
    const given = { middle: new dyno.DynoVec2({ value: middle }), east: new dyno.DynoVec3({ value: east }), north: new dyno.DynoVec3({ value: north }) };
    return dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
      const hide = new dyno.Dyno({
        inTypes: { gsplat: dyno.Gsplat, mask: 'int', middle: 'vec2', east: 'vec3', north: 'vec3' },
        outTypes: { gsplat: dyno.Gsplat },
        inputs: { gsplat: gsplat!, mask, ...given },
        globals: () => [dyno.defineGsplat],
        statements: ({ inputs, outputs }) => [
          `${outputs.gsplat} = ${inputs.gsplat};`,
          `{ vec2 at = vec2(dot(${inputs.gsplat}.center, ${inputs.east}), dot(${inputs.gsplat}.center, ${inputs.north}));`,
          `  int quarter = (at.x >= ${inputs.middle}.x ? 1 : 0) + (at.y >= ${inputs.middle}.y ? 2 : 0);`,
          `  if (((${inputs.mask} >> quarter) & 1) == 1) ${outputs.gsplat}.flags = 0u; }`,
        ],
      });
      return { gsplat: hide.outputs.gsplat };
    });
  }

  /** Sets what is visible, from the cut and what is loaded. A block hides a quarter only once a loaded child covers it. */
  private arrange(): void {
    const wanted = new Set<Node>();
    for (const n of this.cut.masks.keys()) for (let p: Node | null = n; p && !wanted.has(p); p = p.parent) wanted.add(p);
    const ready = new Map<Node, boolean>();
    const loaded = (n: Node): boolean => n.block.artefact !== null && !!this.held.get(n.block.artefact)?.mesh;
    const covers = (n: Node): boolean => {
      let known = ready.get(n);
      if (known === undefined) ready.set(n, known = loaded(n) || n.children.every((c) => c !== null && wanted.has(c) && covers(c)));
      return known;
    };
    const settled = (n: Node): boolean => (loaded(n) ? this.held.get(n.block.artefact!)!.settled === 'yes' : n.children.every((c) => c !== null && settled(c)));
    this.shown.clear();
    const visit = (n: Node): void => {
      let mask = 0;
      n.children.forEach((c, quarter) => {
        if (!c || !wanted.has(c) || !covers(c)) return;
        visit(c);
        if (settled(c)) mask |= 1 << quarter;
      });
      if (mask === 15 || !loaded(n)) return;
      const held = this.held.get(n.block.artefact!)!;
      if (held.mask.value !== mask) { held.mask.value = mask; held.mesh!.updateVersion(); }
      this.shown.set(n, mask);
    };
    for (const n of wanted) if (!n.parent || !wanted.has(n.parent)) visit(n);
    const visible = new Map([...this.shown.keys()].map((n) => [n.block.artefact!, n]));
    for (const [key, held] of this.held) {
      if (!held.mesh) continue;
      const n = visible.get(key);
      held.mesh.visible = n !== undefined;
      if (!n) continue;
      if (held.settled === 'no') {
        held.settled = 'soon';
        this.settle(key, held);
      }
      held.used = this.turn;
      const colour = new THREE.Color(this.tint ? TINTS[n.level % TINTS.length] : '#ffffff');
      if (!held.mesh.recolor.equals(colour)) { held.mesh.recolor.copy(colour); held.mesh.updateVersion(); }
    }
    this.drop();
  }

  private settle(key: string, held: Held): void {
    setTimeout(() => {
      if (this.closed || this.held.get(key) !== held) return;
      // The first chunk brings the encoding. On a slow line it takes longer than a while.
      if (held.mesh!.paged && !held.mesh!.paged.splatEncoding) { this.settle(key, held); return; }
      held.settled = 'yes';
      this.arrange();
      this.changed();
    }, SETTLE_MILLIS);
  }

  retint(on: boolean): void {
    this.tint = on;
    this.arrange();
  }

  private drop(): void {
    const idle = [...this.held].filter(([, h]) => h.mesh && !h.mesh.visible).sort((a, b) => a[1].used - b[1].used);
    for (const [key, h] of idle.slice(0, Math.max(0, idle.length - KEPT))) {
      this.group.remove(h.mesh!);
      h.mesh!.dispose();
      this.held.delete(key);
    }
  }
}

/** A file's splats by pages; its first chunk may be on the way already. */
function paged(rootUrl: string, shDegree: number): PagedSplats {
  const options = { rootUrl, fileType: SplatFileType.RAD };
  const first = takeFirst(rootUrl);
  // Spark's own constructor asks for the header and keeps the promise, so an override must not come back to it: another reads what failed.
  class Begun extends PagedSplats {
    private own: PagedSplats | undefined;
    override getRadMeta() { return first!.then((opened) => opened ?? (this.own ??= new PagedSplats(options)).getRadMeta()); }
  }
  const splats = first ? new Begun(options) : new PagedSplats(options);
  // Spark reads it from the first chunk, and its program depends on it.
  splats.numSh = shDegree;
  return splats;
}

async function hasRad(url: string): Promise<'rad' | 'spz'> {
  return (await fetch(url, { headers: { range: 'bytes=0-15' } })).ok ? 'rad' : 'spz';
}

function top(n: Node): Node {
  let t = n;
  for (let p = n.parent; p; p = p.parent) if (p.block.artefact !== null) t = p;
  return t;
}

function origin(n: Node): [number, number, number] {
  return n.block.origin ?? [0, 0, 0];
}
