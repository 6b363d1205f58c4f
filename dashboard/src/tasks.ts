// Plan and tasks of one job as typed arrays: 10,000 blocks are drawn and sorted from these, not from objects.
import { effect, signal } from '@preact/signals';
import { get, type Letter, type Plan, type TaskChange, type Tasks } from './api';
import { generation, jobId, onTasks } from './live';

export const LETTERS: Letter[] = ['w', 'r', 'l', 'd', 'f', 'q'];
export const NAMES = ['waiting', 'ready', 'running', 'done', 'failed', 'quarantined'];
export const [WAITING, READY, RUNNING, DONE, FAILED, QUARANTINED] = [0, 1, 2, 3, 4, 5] as const;

/** Columns by task number. NaN = not known. */
export class TaskTable {
  readonly length: number;
  readonly state: Uint8Array;
  readonly progress: Uint16Array;
  readonly splats: Float64Array;
  readonly loss: Float32Array;
  readonly speed: Float32Array;
  readonly psnr: Float32Array;
  readonly attempt: Uint16Array;
  readonly worker: string[];
  /** Levels that blocks are on, with the root's: 1 where the root is all. */
  readonly levels: number;
  seq: number;

  constructor(readonly job: number, readonly plan: Plan, tasks: Tasks) {
    const number = (column: (number | null)[]): Float32Array => Float32Array.from(column, (v) => v ?? NaN);
    this.length = tasks.state.length;
    this.levels = plan.blocks.level.reduce((most, l) => Math.max(most, l + 1), 1);
    this.state = Uint8Array.from(tasks.state, (s) => LETTERS.indexOf(s as Letter));
    this.progress = Uint16Array.from(tasks.progress);
    this.splats = Float64Array.from(tasks.splats);
    this.loss = number(tasks.loss);
    this.speed = number(tasks.speed);
    this.psnr = number(tasks.psnr);
    this.attempt = Uint16Array.from(tasks.attempt);
    this.worker = tasks.worker.slice();
    this.seq = tasks.seq;
  }

  get blocks(): number {
    return this.plan.blocks.level.length;
  }

  take(c: TaskChange): void {
    this.state[c.t] = LETTERS.indexOf(c.s);
    this.progress[c.t] = c.p;
    this.splats[c.t] = c.n;
    this.loss[c.t] = c.l ?? NaN;
    this.speed[c.t] = c.v ?? NaN;
    this.worker[c.t] = c.w;
    this.attempt[c.t] = c.a;
    if (c.q !== undefined) this.psnr[c.t] = c.q ?? NaN;
  }

  name(task: number): string {
    const b = this.plan.blocks;
    if (task < this.blocks) return `${b.level[task]}/${b.x[task]}/${b.y[task]}`;
    const other = task - this.blocks;
    const { evaluations, detections } = this.plan;
    if (other < evaluations) return `evaluation ${other + 1}`;
    const rest = other - evaluations;
    return rest < detections ? `detection ${rest + 1}` : `object ${rest - detections + 1}`;
  }

  /** Edge of a block of this level, in metres. */
  edge(level: number): number {
    return this.plan.root.edge / 2 ** level;
  }
}

export const table = signal<TaskTable | null>(null);
/** Counts changes of `table`'s columns: read it to be drawn again. */
export const version = signal(0);
export const tableError = signal('');

let waiting: { changes: TaskChange[]; seq: number }[] = [];
let psnrDue = 0;

onTasks((job, changes, seq) => {
  const t = table.peek();
  if (t === null || String(t.job) !== job) {
    waiting.push({ changes, seq });
    if (waiting.length > 400) waiting.shift();
    return;
  }
  if (seq <= t.seq) return;
  const finished = changes.some((c) => c.s === 'd' && c.q === undefined && t.state[c.t] !== DONE);
  for (const c of changes) if (c.t < t.length) t.take(c);
  t.seq = seq;
  version.value += 1;
  // Where deltas carry no PSNR, it is read again, at most every 10 s, when a block has finished.
  if (finished && psnrDue === 0) psnrDue = window.setTimeout(() => { psnrDue = 0; void refreshPsnr(t); }, 10000);
});

async function refreshPsnr(t: TaskTable): Promise<void> {
  try {
    const tasks = await get<Tasks>(`/api/jobs/${t.job}/tasks`);
    tasks.psnr.forEach((v, i) => { t.psnr[i] = v ?? NaN; });
    version.value += 1;
  } catch {
    // The next finished block asks again.
  }
}

async function load(job: number): Promise<void> {
  waiting = [];
  try {
    const [plan, tasks] = await Promise.all([get<Plan>(`/api/jobs/${job}/plan`), get<Tasks>(`/api/jobs/${job}/tasks`)]);
    if (jobId.peek() !== job) return;
    const next = new TaskTable(job, plan, tasks);
    for (const { changes, seq } of waiting) if (seq > next.seq) for (const c of changes) next.take(c);
    waiting = [];
    table.value = next;
    tableError.value = '';
    version.value += 1;
  } catch (e) {
    tableError.value = (e as Error).message;
  }
}

effect(() => {
  const job = jobId.value;
  void generation.value;
  if (table.peek()?.job !== job) table.value = null;
  if (job !== null) void load(job);
});
