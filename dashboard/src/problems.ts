// What needs attention, from the live state alone. Order: blocked > failed > lost worker > straggler > quality outlier.
import type { Event, Job, Worker } from './api';
import { FAILED, QUARANTINED, RUNNING, type TaskTable } from './tasks';

export type Kind = 'blocked' | 'failed' | 'lost' | 'straggler' | 'outlier';

export interface Problem {
  kind: Kind;
  what: string;
  /** Why, and what the system or the reader can do. */
  note: string;
  tasks: number[];
  worker: string;
  since: number | null;
}

export const KIND_TEXT: Record<Kind, string> = {
  blocked: 'Blocked', failed: 'Failed', lost: 'Lost worker', straggler: 'Straggler', outlier: 'Quality',
};
const ORDER: Kind[] = ['blocked', 'failed', 'lost', 'straggler', 'outlier'];

export function problems(job: Job | null, table: TaskTable | null, workers: Worker[], events: Event[]): Problem[] {
  const found = [...blocked(job, workers), ...lost(workers, job)];
  if (job && table && table.job === job.id) found.push(...failed(table, events), ...stragglers(table), ...outliers(table));
  return found.sort((a, b) => ORDER.indexOf(a.kind) - ORDER.indexOf(b.kind) || b.tasks.length - a.tasks.length);
}

function blocked(job: Job | null, workers: Worker[]): Problem[] {
  if (!job) return [];
  const one = (what: string, note: string): Problem[] => [{ kind: 'blocked', what, note, tasks: [], worker: '', since: null }];
  if (job.state === 'incomplete') return one(`${job.name} ended incomplete`, 'Blocks below a failed one were not trained. Retry the failed blocks.');
  if (job.state !== 'running' || job.counts.leased > 0) return [];
  const live = workers.filter((w) => w.state === 'busy' || w.state === 'idle');
  if (live.length === 0) return one('No worker is connected', 'Start one: plat worker --coordinator URL');
  const reasons = [...new Set(live.filter((w) => w.state === 'idle').map((w) => w.idle_reason))];
  if (job.counts.ready > 0) return one(`${job.counts.ready} ${job.counts.ready === 1 ? 'task is' : 'tasks are'} ready, none runs`, reasons.join('; ') || 'The workers are busy with other jobs.');
  return [];
}

function lost(workers: Worker[], job: Job | null): Problem[] {
  const gone = workers.filter((w) => w.state === 'lost');
  if (gone.length === 0) return [];
  const since = Math.min(...gone.map((w) => w.heard_unix_ms));
  const what = gone.length === 1 ? `${gone[0]!.name} is silent` : `${gone.length} workers are silent`;
  const note = job?.state === 'running' ? 'Their tasks go to other workers.' : '';
  return [{ kind: 'lost', what, note, tasks: [], worker: gone.length === 1 ? gone[0]!.name : '', since }];
}

/** The cause without what differs from case to case, so that a storm of one cause is one row. */
export function cause(what: string): string {
  return what.replace(/^attempt \d+ (failed|ended|lost)[:,]?\s*/i, '').replace(/\d[\d.,]*/g, '#').replace(/#\S*\.(jpe?g|png)/g, '#').trim();
}

function failed(table: TaskTable, events: Event[]): Problem[] {
  const last = new Map<number, Event>();
  for (const e of events) if (e.task !== null && e.level === 'error' && e.job === table.job) last.set(e.task, e);
  const rows = new Map<string, Problem>();
  for (let t = 0; t < table.length; t += 1) {
    const state = table.state[t];
    if (state !== FAILED && state !== QUARANTINED) continue;
    const event = last.get(t);
    const key = `${state} ${event ? cause(event.what) : ''}`;
    const row = rows.get(key);
    if (row) {
      row.tasks.push(t);
      if (event) row.since = Math.min(row.since ?? event.unix_ms, event.unix_ms);
      continue;
    }
    const verb = state === FAILED ? 'failed' : 'quarantined';
    rows.set(key, { kind: 'failed', what: verb, note: event?.what ?? 'The reasons are in their attempts.', tasks: [t], worker: '', since: event?.unix_ms ?? null });
  }
  for (const row of rows.values()) {
    const n = row.tasks.length;
    row.what = n === 1 ? `${table.name(row.tasks[0]!)} ${row.what}` : `${n} blocks ${row.what}${row.since === null ? '' : ', same cause'}`;
  }
  return [...rows.values()];
}

function stragglers(table: TaskTable): Problem[] {
  const running: number[] = [];
  for (let t = 0; t < table.blocks; t += 1) if (table.state[t] === RUNNING && table.speed[t]! > 0) running.push(t);
  if (running.length < 4) return [];
  const middle = median(running.map((t) => table.speed[t]!));
  return running.filter((t) => table.speed[t]! < middle / 2).slice(0, 5).map((t) => ({
    kind: 'straggler', what: `${table.name(t)} is slow`, tasks: [t], worker: table.worker[t]!, since: null,
    note: `${table.speed[t]!.toFixed(1)} steps/s on ${table.worker[t]}; the median is ${middle.toFixed(1)}.`,
  }));
}

function outliers(table: TaskTable): Problem[] {
  const byLevel = new Map<number, number[]>();
  for (let t = 0; t < table.blocks; t += 1) {
    if (Number.isNaN(table.psnr[t]!)) continue;
    const level = table.plan.blocks.level[t]!;
    const row = byLevel.get(level);
    if (row) row.push(t);
    else byLevel.set(level, [t]);
  }
  const found: Problem[] = [];
  for (const [level, tasks] of byLevel) {
    if (tasks.length < 8) continue;
    const middle = median(tasks.map((t) => table.psnr[t]!));
    const low = tasks.filter((t) => table.psnr[t]! < middle - 3).sort((a, b) => table.psnr[a]! - table.psnr[b]!);
    if (low.length === 0) continue;
    found.push({
      kind: 'outlier', tasks: low, worker: '', since: null,
      what: low.length === 1 ? `${table.name(low[0]!)} at ${table.psnr[low[0]!]!.toFixed(1)} dB` : `${low.length} blocks of level ${level} look poor`,
      note: `More than 3 dB below the median of level ${level}, ${middle.toFixed(1)} dB.`,
    });
  }
  return found;
}

export function median(values: number[]): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.floor(sorted.length / 2)] ?? NaN;
}
