// Which blocks to draw: the deepest finished ones that the budget affords, nearer and larger on screen first.
//
// A block's error on screen is its resolution over its distance. Starting from the coarsest finished blocks, the
// quarter with the greatest error is handed from a block to its child, until the budget is spent. A block whose four
// quarters are handed on is not drawn; one that has handed on some is drawn in the others only (`mask`).
import type { ModelBlock, Square } from '../api';

export interface Node {
  block: ModelBlock;
  level: number;
  x: number;
  y: number;
  parent: Node | null;
  /** By quarter: 0 south-west, 1 south-east, 2 north-west, 3 north-east. */
  children: [Node | null, Node | null, Node | null, Node | null];
}

export interface Eye {
  at: [number, number, number];
  forward: [number, number, number];
}

export interface Cut {
  /** Each drawn block and the quarters (bits) that its children draw. */
  masks: Map<Node, number>;
  splats: number;
  /** Blocks that were not handed on because the budget was spent. */
  held: number;
}

export function tree(blocks: ModelBlock[]): Node[] {
  const nodes = blocks.map((block): Node => {
    const [level, x, y] = block.block.split('/').map(Number) as [number, number, number];
    return { block, level, x, y, parent: null, children: [null, null, null, null] };
  });
  const at = new Map(nodes.map((n) => [n.block.block, n]));
  for (const n of nodes) {
    const parent = at.get(`${n.level - 1}/${n.x >> 1}/${n.y >> 1}`);
    if (!parent) continue;
    n.parent = parent;
    parent.children[(n.x & 1) + 2 * (n.y & 1)] = n;
  }
  return nodes;
}

export function square(n: Node, root: Square): Square {
  const edge = root.edge / 2 ** n.level;
  return { x: root.x + n.x * edge, y: root.y + n.y * edge, edge };
}

type Point = [x: number, y: number];

/** Where two of the drawn blocks meet: a part of the one's border and of the other's. `drawn` has the quarters (bits) that a block's children draw. */
export function meeting(drawn: Map<Node, number>, root: Square): { a: Node; b: Node; from: Point; to: Point }[] {
  const regions = [...drawn].flatMap(([n, mask]) => {
    const { x, y, edge } = square(n, root);
    if (mask === 0) return [{ n, x, y, edge }];
    return [0, 1, 2, 3].filter((q) => !((mask >> q) & 1)).map((q) => ({ n, x: x + (q & 1 ? edge / 2 : 0), y: y + (q & 2 ? edge / 2 : 0), edge: edge / 2 }));
  });
  // Sides that are the same differ by rounding.
  const near = 1e-6 * root.edge;
  return regions.flatMap((r, i) => regions.slice(i + 1).flatMap((s) => {
    const from: Point = [Math.max(r.x, s.x), Math.max(r.y, s.y)];
    const to: Point = [Math.min(r.x + r.edge, s.x + s.edge), Math.min(r.y + r.edge, s.y + s.edge)];
    const [width, depth] = [to[0] - from[0], to[1] - from[1]];
    const touch = r.n !== s.n && Math.abs(Math.min(width, depth)) < near && Math.max(width, depth) > near;
    return touch ? [{ a: r.n, b: s.n, from, to }] : [];
  }));
}

/** Metres from the eye to the block, at least a hundredth of its edge. */
export function distance(n: Node, root: Square, eye: Eye): number {
  const s = square(n, root);
  const [z0, z1] = n.block.box ? [n.block.box[2]!, n.block.box[5]!] : [0, 0];
  const beyond = (v: number, low: number, high: number): number => Math.max(low - v, 0, v - high);
  return Math.max(s.edge / 100, Math.hypot(beyond(eye.at[0], s.x, s.x + s.edge), beyond(eye.at[1], s.y, s.y + s.edge), beyond(eye.at[2], z0, z1)));
}

/** The error on screen; what lies behind the eye counts a fifth, for when the eye turns. */
export function error(n: Node, root: Square, eye: Eye): number {
  const s = square(n, root);
  const [dx, dy] = [s.x + s.edge / 2 - eye.at[0], s.y + s.edge / 2 - eye.at[1]];
  const ahead = dx * eye.forward[0] + dy * eye.forward[1];
  return (n.block.rho_metres / distance(n, root, eye)) * (ahead < -0.75 * s.edge ? 0.2 : 1);
}

interface Step { node: Node; quarter: number; child: Node; error: number }

export function cut(nodes: Node[], root: Square, eye: Eye, budget: number): Cut {
  const done = (n: Node | null): n is Node => n !== null && n.block.artefact !== null;
  const masks = new Map<Node, number>();
  const heap = new Heap();
  let splats = 0;
  let held = 0;
  const add = (n: Node): void => {
    masks.set(n, 0);
    splats += n.block.splats;
    const e = error(n, root, eye);
    n.children.forEach((child, quarter) => { if (done(child)) heap.push({ node: n, quarter, child, error: e }); });
  };
  for (const n of nodes) if (done(n) && !hasDoneAncestor(n)) add(n);
  for (let step = heap.pop(); step; step = heap.pop()) {
    // A quarter of the parent goes when the child comes.
    if (splats - step.node.block.splats / 4 + step.child.block.splats > budget) { held += 1; continue; }
    splats -= step.node.block.splats / 4;
    masks.set(step.node, masks.get(step.node)! | (1 << step.quarter));
    add(step.child);
  }
  for (const [n, mask] of masks) if (mask === 15) masks.delete(n);
  return { masks, splats: Math.round(splats), held };
}

function hasDoneAncestor(n: Node): boolean {
  for (let p = n.parent; p; p = p.parent) if (p.block.artefact !== null) return true;
  return false;
}

/** Greatest error first. */
class Heap {
  private readonly items: Step[] = [];

  push(s: Step): void {
    const a = this.items;
    let i = a.push(s) - 1;
    for (let p = (i - 1) >> 1; i > 0 && a[p]!.error < a[i]!.error; p = (i - 1) >> 1) { [a[p], a[i]] = [a[i]!, a[p]!]; i = p; }
  }

  pop(): Step | undefined {
    const a = this.items;
    const top = a[0];
    const last = a.pop();
    if (!top || a.length === 0) return top;
    a[0] = last!;
    for (let i = 0; ;) {
      let c = 2 * i + 1;
      if (c + 1 < a.length && a[c + 1]!.error > a[c]!.error) c += 1;
      if (c >= a.length || a[c]!.error <= a[i]!.error) return top;
      [a[c], a[i]] = [a[i]!, a[c]!];
      i = c;
    }
  }
}
