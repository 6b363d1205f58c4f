// The live state: one snapshot, then numbered deltas.
//
//   one tab per browser holds the Web Lock and the EventSource; it repeats what it hears on a BroadcastChannel
//   the other tabs take GET /api/snapshot once and then the deltas of the channel
//   without either API a tab opens its own EventSource
import { batch, computed, signal } from '@preact/signals';
import { get, type Delta, type Event, type Job, type Server, type Snapshot, type TaskChange, type Worker } from './api';
import { route } from './route';

const EVENTS_KEPT = 2000;
const STALE_MILLIS = 3000;
const LOST_MILLIS = 15000;

export const server = signal<Server | null>(null);
export const jobs = signal<Job[]>([]);
export const workers = signal<Worker[]>([]);
export const events = signal<Event[]>([]);
export const loaded = signal(false);
/** Server time minus browser time, so that ages are right on a machine with another clock. */
export const skewMillis = signal(0);
/** Wall clock of the page; ticks once a second, and ages depend on it. */
export const nowMillis = signal(Date.now());
const heardMillis = signal(Date.now());
const broken = signal(false);

export const silentMillis = computed(() => Math.max(0, nowMillis.value - heardMillis.value));
export const link = computed<'connecting' | 'live' | 'stale' | 'disconnected'>(() => {
  if (broken.value || silentMillis.value > LOST_MILLIS) return 'disconnected';
  if (!loaded.value) return 'connecting';
  return silentMillis.value > STALE_MILLIS ? 'stale' : 'live';
});
/** The server's clock now. */
export const serverNow = computed(() => nowMillis.value + skewMillis.value);

/** The job of the URL; otherwise the first that runs, otherwise the newest. */
export const job = computed<Job | null>(() => {
  const wanted = route.value.query.get('job');
  const all = jobs.value;
  if (wanted !== null) return all.find((j) => String(j.id) === wanted) ?? null;
  return all.find((j) => j.state === 'running') ?? all.at(-1) ?? null;
});
export const jobId = computed(() => job.value?.id ?? null);

let seq = -1;
/** Deltas heard before the first snapshot (a tab that follows fetches its snapshot meanwhile). */
const early: [number, Delta][] = [];
type TaskListener = (job: string, changes: TaskChange[], seq: number) => void;
const taskListeners = new Set<TaskListener>();
/** Calls `listener` with each delta's task changes; returns how to stop it. */
export function onTasks(listener: TaskListener): () => void {
  taskListeners.add(listener);
  return () => { taskListeners.delete(listener); };
}

/** Called after each snapshot: what was derived from deltas must be read again. */
export const generation = signal(0);

function takeSnapshot(s: Snapshot): void {
  seq = s.seq;
  batch(() => {
    server.value = s.server;
    jobs.value = s.jobs;
    workers.value = s.workers;
    events.value = s.events;
    skewMillis.value = s.now_unix_ms - Date.now();
    loaded.value = true;
    generation.value += 1;
    for (const [id, delta] of early.splice(0)) takeDelta(id, delta);
  });
}

function takeDelta(id: number, d: Delta): void {
  if (!loaded.value) {
    early.push([id, d]);
    return;
  }
  if (id <= seq) return;
  seq = id;
  batch(() => {
    if (d.server) server.value = d.server;
    if (d.jobs.length) jobs.value = merged(jobs.value, d.jobs, (j) => j.id);
    if (d.workers.length) workers.value = merged(workers.value, d.workers, (w) => w.name);
    if (d.events.length) events.value = [...events.value, ...d.events].slice(-EVENTS_KEPT);
    skewMillis.value = d.now_unix_ms - Date.now();
    for (const [id_, changes] of Object.entries(d.tasks)) for (const listen of taskListeners) listen(id_, changes, id);
  });
}

function merged<T>(old: T[], changed: T[], key: (t: T) => string | number): T[] {
  const next = new Map(old.map((t) => [key(t), t]));
  for (const t of changed) next.set(key(t), t);
  return [...next.values()];
}

interface Heard { type: string; id: string; data: string }

function take(heard: Heard): void {
  batch(() => {
    heardMillis.value = Date.now();
    nowMillis.value = Date.now();
    broken.value = false;
    if (heard.type === 'snapshot') takeSnapshot(JSON.parse(heard.data) as Snapshot);
    else if (heard.type === 'delta') takeDelta(Number(heard.id), JSON.parse(heard.data) as Delta);
  });
}

const channel = typeof BroadcastChannel === 'undefined' ? null : new BroadcastChannel('plat-live');

function listenToServer(): void {
  const pass = (heard: Heard): void => { take(heard); channel?.postMessage(heard); };
  let source: EventSource | null = null;
  let waitMillis = 1000;
  let openedMillis = 0;
  const open = (): void => {
    openedMillis = Date.now();
    source?.close();
    source = new EventSource('/api/events');
    for (const type of ['snapshot', 'delta', 'tick']) {
      source.addEventListener(type, (e) => {
        waitMillis = 1000;
        pass({ type, id: (e as MessageEvent<string>).lastEventId, data: (e as MessageEvent<string>).data });
      });
    }
    source.addEventListener('resync', () => setTimeout(open, 200));
    source.onopen = () => { broken.value = false; };
    source.onerror = () => {
      // The age must go on counting from the last real message, so heardMillis stays.
      broken.value = true;
      channel?.postMessage({ type: 'lost', id: '', data: '' } satisfies Heard);
      // The browser retries by itself (with Last-Event-ID) unless the server answered with an error.
      if (source?.readyState === EventSource.CLOSED) {
        setTimeout(open, waitMillis);
        waitMillis = Math.min(waitMillis * 2, 15000);
      }
    };
  };
  open();
  // A connection that died without a word (a sleeping laptop, a proxy) raises no error. The server says something each second, so silence tells.
  setInterval(() => {
    if (Date.now() - Math.max(openedMillis, heardMillis.peek()) > LOST_MILLIS) { broken.value = true; open(); }
  }, 2000);
}

function follow(): void {
  if (!channel) return;
  channel.onmessage = (e: MessageEvent<Heard>) => {
    if (e.data.type === 'lost') broken.value = true;
    else take(e.data);
  };
  const first = async (): Promise<void> => {
    try {
      takeSnapshot(await get<Snapshot>('/api/snapshot'));
      heardMillis.value = Date.now();
    } catch {
      setTimeout(first, 2000);
    }
  };
  void first();
}

export function start(): void {
  setInterval(() => { nowMillis.value = Date.now(); }, 1000);
  if (!channel || !navigator.locks) {
    listenToServer();
    return;
  }
  let leads = false;
  void navigator.locks.request('plat-live', () => {
    leads = true;
    channel.onmessage = null;
    listenToServer();
    // Held until the tab goes; then the next tab in line becomes the one that listens.
    return new Promise<void>(() => {});
  });
  setTimeout(() => { if (!leads) follow(); }, 50);
}
