// Lines and planes in the scene: outlines of the drawn blocks, seams where two of them meet, ghost boxes of blocks not finished.
import * as THREE from 'three';
import type { ModelView } from '../api';
import { meeting, square, type Node } from './cut';

/** A face is red from this jump on, levels of 255: the page says so below the picture. */
const GREATEST_JUMP = 8;

export class Boxes {
  readonly group = new THREE.Group();
  private readonly outlines = lines(0xffffff, 0.55);
  private readonly edges = lines(0xffffff, 0.95, true);
  private readonly faces = planes(0.3);
  private readonly ghosts = lines(0xf0a350, 0.8);
  /** What is written where, in the local frame; of a ghost with its task. */
  labels: { text: string; task: number | null; at: THREE.Vector3 }[] = [];

  constructor(private readonly model: ModelView) {
    this.group.add(this.outlines, this.edges, this.faces, this.ghosts);
  }

  /** `drawn` has each drawn block and the quarters (bits) that its children draw. */
  show(drawn: Map<Node, number>, nodes: Node[], what: { outlines: boolean; seams: boolean; ghosts: boolean }): void {
    const [z0, z1] = this.heights(nodes);
    const outline: number[] = [];
    const ghost: number[] = [];
    if (what.outlines) for (const n of drawn.keys()) this.box(outline, n, n.block.box?.[2] ?? z0, n.block.box?.[5] ?? z1);
    this.labels = [];
    this.seams(what.seams ? drawn : new Map(), z0, z1);
    if (what.ghosts) {
      // A ghost is the coarsest unfinished block of its branch: its parent stands in for it meanwhile.
      for (const n of nodes) {
        if (n.block.artefact !== null || (n.parent !== null && n.parent.block.artefact === null)) continue;
        this.box(ghost, n, z0, z0 + 0.5 * (z1 - z0));
        const s = square(n, this.model.root);
        this.labels.push({ text: n.block.block, task: n.block.task, at: this.local(s.x + s.edge / 2, s.y + s.edge / 2, z0 + 0.5 * (z1 - z0)) });
      }
    }
    fill(this.outlines, outline);
    fill(this.ghosts, ghost);
  }

  /** The faces between drawn blocks, from the lowest to the greatest height; coloured by how far the two differ, where that was measured. */
  private seams(drawn: Map<Node, number>, low: number, high: number): void {
    const jumps = new Map((this.model.faces ?? []).flatMap(({ a, b, jump }) => [[`${a} ${b}`, jump], [`${b} ${a}`, jump]] as const));
    const [edge, edgeColour, face, faceColour]: number[][] = [[], [], [], []];
    for (const { a, b, from, to } of meeting(drawn, this.model.root)) {
      const jump = jumps.get(`${a.block.block} ${b.block.block}`) ?? null;
      const colour = jump === null ? new THREE.Color(0xff5fc0) : new THREE.Color().setHSL((1 - Math.min(1, jump / GREATEST_JUMP)) / 3, 0.9, 0.5);
      const [p, q, r, s] = [this.local(...from, low), this.local(...to, low), this.local(...to, high), this.local(...from, high)];
      for (const v of [p, q, r, p, r, s]) { face!.push(...v.toArray()); faceColour!.push(...colour.toArray()); }
      for (const v of [p, q, q, r, r, s, s, p]) { edge!.push(...v.toArray()); edgeColour!.push(...colour.toArray()); }
      if (jump !== null) this.labels.push({ text: jump.toFixed(1), task: null, at: r.clone().add(s).multiplyScalar(0.5) });
    }
    fill(this.edges, edge!, edgeColour);
    fill(this.faces, face!, faceColour);
  }

  /** Lowest and greatest height of what is finished; a tenth of the scene where nothing is. */
  heights(nodes: Node[]): [number, number] {
    let [low, high] = [Infinity, -Infinity];
    for (const { block } of nodes) if (block.box && !block.backdrop) { low = Math.min(low, block.box[2]!); high = Math.max(high, block.box[5]!); }
    // Floaters far above must not make towers of the boxes.
    return low < high ? [low, Math.min(high, low + 0.15 * this.model.root.edge)] : [0, 0.05 * this.model.root.edge];
  }

  private local(x: number, y: number, z: number): THREE.Vector3 {
    const c = this.model.centre;
    return new THREE.Vector3(x - c[0], y - c[1], z - c[2]);
  }

  private box(out: number[], n: Node, z0: number, z1: number): void {
    const top = Math.min(z1, z0 + square(n, this.model.root).edge);
    this.border(out, n, z0);
    this.border(out, n, top);
    for (const [x, y] of this.corners(n)) out.push(...this.local(x, y, z0).toArray(), ...this.local(x, y, top).toArray());
  }

  private border(out: number[], n: Node, z: number): void {
    const c = this.corners(n);
    c.forEach(([x, y], i) => { const [u, v] = c[(i + 1) % 4]!; out.push(...this.local(x, y, z).toArray(), ...this.local(u, v, z).toArray()); });
  }

  private corners(n: Node): [number, number][] {
    const { x, y, edge } = square(n, this.model.root);
    return [[x, y], [x + edge, y], [x + edge, y + edge], [x, y + edge]];
  }
}

function lines(color: number, opacity: number, vertexColors = false): THREE.LineSegments {
  return over(new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color, vertexColors, transparent: true, opacity, depthTest: false })));
}

function planes(opacity: number): THREE.Mesh {
  return over(new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({ vertexColors: true, side: THREE.DoubleSide, transparent: true, opacity, depthTest: false })));
}

function over<T extends THREE.Object3D>(made: T): T {
  made.renderOrder = 10;
  made.frustumCulled = false;
  return made;
}

function fill(made: THREE.LineSegments | THREE.Mesh, points: number[], colours?: number[]): void {
  made.geometry.dispose();
  made.geometry = new THREE.BufferGeometry();
  made.geometry.setAttribute('position', new THREE.Float32BufferAttribute(points, 3));
  if (colours) made.geometry.setAttribute('color', new THREE.Float32BufferAttribute(colours, 3));
  made.visible = points.length > 0;
}
