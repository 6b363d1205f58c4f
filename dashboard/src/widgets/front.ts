// Speed against accuracy, as pure functions: which runs are comparable, which lie on the front, what dominates one.
import type { Result } from '../api';

export type XAxis = 'cpu_seconds' | 'wall_seconds';
export type YAxis = 'psnr' | 'ssim' | 'perceptual';

export interface Run {
  id: number;
  r: Result;
  x: number;
  y: number;
}

export function runs(results: Result[], x: XAxis, y: YAxis): Run[] {
  return results.flatMap((r, id) => {
    const [a, b] = [r[x], r[y]];
    return a !== null && a > 0 && b !== null && Number.isFinite(b) ? [{ id, r, x: a, y: b }] : [];
  });
}

/** The split of most runs: the one whose front is drawn. */
export function mainSplit(results: Result[]): string {
  const n = new Map<string, number>();
  for (const r of results) if (r.source === null) n.set(r.split, (n.get(r.split) ?? 0) + 1);
  return [...n].sort((a, b) => b[1] - a[1])[0]?.[0] ?? '';
}

/** Runs that no other one beats in both, from fast to slow. Published figures are not ours to join. */
export function front(all: Run[], split: string): Run[] {
  const mine = all.filter((p) => p.r.source === null && p.r.split === split).sort((a, b) => a.x - b.x || b.y - a.y);
  const kept: Run[] = [];
  for (const p of mine) if (kept.length === 0 || p.y > kept.at(-1)!.y) kept.push(p);
  return kept;
}

/** The run of the front that beats `p` by most, or null. */
export function dominator(p: Run, line: Run[]): Run | null {
  if (line.includes(p)) return null;
  const better = line.filter((q) => q.x <= p.x && q.y >= p.y && (q.x < p.x || q.y > p.y));
  return better.at(-1) ?? null;
}

export const ROWS: [title: string, key: keyof Result, digits: number | null][] = [
  ['Scene', 'scene', null], ['Split', 'split', null], ['Source', 'source', null], ['Commit', 'commit', null], ['Machine', 'machine', null], ['Backend', 'backend', null],
  ['Workers', 'workers', 0], ['Downscale', 'downscale', 0], ['Steps', 'steps', 0], ['Budget', 'budget', 0], ['Splats', 'splats', 0],
  ['CPU seconds', 'cpu_seconds', 1], ['Wall seconds', 'wall_seconds', 1], ['PSNR, dB', 'psnr', 3], ['SSIM', 'ssim', 4], ['LPIPS', 'lpips', 4], ['SSIMULACRA2', 'perceptual', 2],
];

export function csv(results: Result[]): string {
  const keys = ['label', ...ROWS.map(([, key]) => key)] as (keyof Result)[];
  const cell = (v: unknown): string => (v === null || v === undefined ? '' : /[",\n]/.test(String(v)) ? `"${String(v).replaceAll('"', '""')}"` : String(v));
  return [keys.join(','), ...results.map((r) => keys.map((k) => cell(r[k])).join(','))].join('\n');
}
