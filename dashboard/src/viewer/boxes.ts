// Lines in the scene: outlines of the drawn blocks, seams where two of them meet, ghost boxes of blocks not finished.
import * as THREE from 'three';
import type { ModelView } from '../api';
import { square, type Node } from './cut';

export class Boxes {
  readonly group = new THREE.Group();
  private readonly outlines = lines(0xffffff, 0.55);
  private readonly seams = lines(0xff5fc0, 0.95);
  private readonly ghosts = lines(0xf0a350, 0.8);
  /** Ghosts and where their labels go, in the local frame. */
  labels: { node: Node; at: THREE.Vector3 }[] = [];

  constructor(private readonly model: ModelView) {
    this.group.add(this.outlines, this.seams, this.ghosts);
  }

  show(drawn: Set<Node>, nodes: Node[], what: { outlines: boolean; seams: boolean; ghosts: boolean }): void {
    const [z0, z1] = this.heights(nodes);
    const outline: number[] = [];
    const seam: number[] = [];
    const ghost: number[] = [];
    if (what.outlines) for (const n of drawn) this.box(outline, n, n.block.box?.[2] ?? z0, n.block.box?.[5] ?? z1);
    if (what.seams) for (const n of drawn) this.border(seam, n, (n.block.box?.[2] ?? z0) + 0.2);
    this.labels = [];
    if (what.ghosts) {
      // A ghost is the coarsest unfinished block of its branch: its parent stands in for it meanwhile.
      for (const n of nodes) {
        if (n.block.artefact !== null || (n.parent !== null && n.parent.block.artefact === null)) continue;
        this.box(ghost, n, z0, z0 + 0.5 * (z1 - z0));
        const s = square(n, this.model.root);
        this.labels.push({ node: n, at: this.local(s.x + s.edge / 2, s.y + s.edge / 2, z0 + 0.5 * (z1 - z0)) });
      }
    }
    fill(this.outlines, outline);
    fill(this.seams, seam);
    fill(this.ghosts, ghost);
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

function lines(colour: number, opacity: number): THREE.LineSegments {
  const made = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: colour, transparent: true, opacity, depthTest: false }));
  made.renderOrder = 10;
  made.frustumCulled = false;
  return made;
}

function fill(made: THREE.LineSegments, points: number[]): void {
  made.geometry.dispose();
  made.geometry = new THREE.BufferGeometry();
  made.geometry.setAttribute('position', new THREE.Float32BufferAttribute(points, 3));
  made.visible = points.length > 0;
}
