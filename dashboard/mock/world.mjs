// A simulated job, by seed and tick number only: the same calls give the same answers.

export function random(seed) {
  let s = seed >>> 0;
  return () => {
    s = (s + 0x6d2b79f5) >>> 0;
    let t = Math.imul(s ^ (s >>> 15), 1 | s);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

export const TICK_MILLIS = 500;
const EDGE = 1638.4;

/** `shape`: { name, blocks, levels, workers, seed, failures, speed } */
export class Sim {
  constructor(id, shape, shared) {
    this.id = id;
    this.shape = shape;
    this.shared = shared; // { seq, log(event), now() }
    this.random = random(shape.seed);
    this.cpu = 0;
    this.paused = false;
    this.cancelled = false;
    this.priority = 0;
    this.plan = makePlan(shape, this.random);
    const n = this.plan.blocks.level.length;
    this.tasks = Array.from({ length: n + this.plan.evaluations }, (_, t) => ({
      s: 'w', p: 0, n: 0, l: null, v: null, w: '', a: 0, psnr: null, attempts: [], curve: [],
      steps: t < n ? this.plan.blocks.steps[t] : 1,
    }));
    this.parents = parents(this.plan);
    this.changed = new Set();
    this.curve = { cpu_seconds: [], wall_seconds: [], psnr: [], splats: [] };
    this.started = shared.now();
    this.ended = null;
    this.workers = Array.from({ length: shape.workers }, (_, i) => ({
      name: `w${String(i + 1).padStart(shape.workers > 9 ? 2 : 1, '0')}`, backend: i % 3 === 2 ? 'gpu' : 'cpu', state: 'idle',
      job: null, task: null, attempt: 0, heard_unix_ms: shared.now(), since_unix_ms: shared.now(), idle_reason: 'no task is ready',
      memory_bytes: i % 4 === 3 ? 0 : 16e9, done: 0, failed: 0, steps_per_second: null, slow: i === 1 ? 0.35 : 0.85 + 0.3 * this.random(),
    }));
    this.free();
  }

  say(level, what, task = null, worker = '', attempt = 0) {
    this.shared.log({ job: this.id, task, attempt, worker, level, what });
  }

  /** Tasks whose parent is done become ready; evaluations wait for all blocks. */
  free() {
    const n = this.plan.blocks.level.length;
    let open = 0;
    for (let t = 0; t < n; t += 1) {
      const task = this.tasks[t];
      if (task.s !== 'd' && task.s !== 'q' && task.s !== 'f') open += 1;
      const parent = this.parents[t];
      if (task.s === 'w' && (parent === null || this.tasks[parent].s === 'd')) this.set(t, { s: 'r' });
    }
    if (open === 0) for (let t = n; t < this.tasks.length; t += 1) if (this.tasks[t].s === 'w') this.set(t, { s: 'r' });
    this.next = this.tasks.findIndex((task) => task.s === 'r');
  }

  set(t, change) {
    Object.assign(this.tasks[t], change);
    this.changed.add(t);
  }

  tick() {
    const now = this.shared.now();
    let finished = false;
    for (const w of this.workers) {
      if (w.state === 'lost' || w.state === 'left') continue;
      w.heard_unix_ms = now;
      if (w.state === 'idle' && !this.paused && !this.cancelled) this.lease(w, now);
      if (w.state === 'busy') finished = this.work(w, now) || finished;
    }
    if (finished) this.free();
    const state = this.state();
    if (this.ended === null && state !== 'running' && state !== 'paused') {
      this.ended = now;
      this.say(state === 'done' ? 'info' : 'warn', state === 'done' ? 'job done' : `job ended: ${state}`);
    }
  }

  lease(w, now) {
    const t = this.next;
    if (t < 0 || t === undefined) {
      w.idle_reason = this.tasks.some((x) => x.s === 'w') ? 'no task is ready: all wait for their parents' : 'no task is left';
      return;
    }
    const a = this.tasks[t].a + 1;
    this.set(t, { s: 'l', w: w.name, a, p: 0, l: 0.4 });
    this.tasks[t].attempts.push({ number: a, worker: w.name, began_unix_ms: now, ended_unix_ms: null, end: 'running', reason: '' });
    Object.assign(w, { state: 'busy', job: this.id, task: t, attempt: a, since_unix_ms: now, idle_reason: '' });
    this.say('info', `attempt ${a} began`, t, w.name, a);
    do this.next += 1; while (this.next < this.tasks.length && this.tasks[this.next].s !== 'r');
    if (this.next >= this.tasks.length) this.next = -1;
  }

  work(w, now) {
    const task = this.tasks[w.task];
    const n = this.plan.blocks.level.length;
    const p = Math.min(1000, task.p + Math.round(this.shape.speed * w.slow * (0.7 + 0.6 * this.random())));
    const share = p / 1000;
    const level = this.plan.blocks.level[w.task] ?? 0;
    const speed = (task.steps * (p - task.p)) / 1000 / (TICK_MILLIS / 1000);
    const budget = this.plan.blocks.budget[w.task] ?? 0;
    w.steps_per_second = +speed.toFixed(2);
    this.cpu += (TICK_MILLIS / 1000) * 3.8;
    this.set(w.task, {
      p, v: w.steps_per_second,
      n: w.task < n ? Math.round(budget * (0.25 + 0.75 * Math.min(1, share * 1.4))) : 0,
      l: +(0.03 + 0.02 * level + 0.35 * Math.exp(-5 * share) + 0.01 * this.random()).toFixed(4),
    });
    if (task.curve.length < 512) task.curve.push([task.a, Math.round(task.steps * share), task.l, task.n, this.cpu, (now - this.started) / 1000]);
    const fails = task.a <= 3 && this.shape.failures > 0 && p > 400
      && (hash(this.shape.seed, w.task, task.a) < this.shape.failures || hash(this.shape.seed, w.task, 55) < this.shape.failures / 4);
    if (fails) {
      const poison = hash(this.shape.seed, w.task, 99) < 0.3;
      const reason = poison ? 'loss is not a number at step 1310: view 000231.jpg has an empty mask'
        : 'out of memory: 412 MB asked, 16.0 GB budget used up';
      this.end(w, now, 'failed', reason);
      w.failed += 1;
      const t = w.was;
      this.set(t, task.a >= 3 ? { s: poison ? 'q' : 'f', v: null } : { s: 'r', p: 0, v: null });
      this.say('error', `attempt ${task.a} failed: ${reason}`, t, w.name, task.a);
      return true;
    }
    if (p < 1000) return false;
    this.end(w, now, 'done', '');
    w.done += 1;
    const psnr = w.was < n ? +(24.5 + 1.2 * level + 2.4 * hash(this.shape.seed, w.was, 7) - (hash(this.shape.seed, w.was, 8) > 0.96 ? 6 : 0)).toFixed(2) : null;
    this.set(w.was, { s: 'd', p: 1000, v: null, psnr });
    this.say('info', `attempt ${task.a} done${psnr ? `: ${psnr} dB` : ''}`, w.was, w.name, task.a);
    if (psnr) {
      this.curve.cpu_seconds.push(+this.cpu.toFixed(1));
      this.curve.wall_seconds.push((now - this.started) / 1000);
      this.curve.psnr.push(+(20 + 7 * this.doneShare() ** 0.3).toFixed(3));
      this.curve.splats.push(this.splats());
    }
    return true;
  }

  end(w, now, how, reason) {
    const last = this.tasks[w.task].attempts.at(-1);
    Object.assign(last, { ended_unix_ms: now, end: how, reason });
    Object.assign(w, { was: w.task, state: 'idle', job: null, task: null, attempt: 0, since_unix_ms: now, idle_reason: 'no task is ready', steps_per_second: null });
  }

  lose(name) {
    const w = this.workers.find((x) => x.name === name && x.state !== 'lost') ?? this.workers.find((x) => x.state === 'busy');
    if (!w) return null;
    const now = this.shared.now();
    if (w.task !== null) {
      const t = w.task;
      this.end(w, now, 'lost', 'no heartbeat for 10 s');
      this.set(t, { s: 'r', p: 0, v: null, w: '' });
      if (this.next < 0 || t < this.next) this.next = t;
    }
    Object.assign(w, { state: 'lost', since_unix_ms: now, heard_unix_ms: now - 10000 });
    this.say('error', `worker ${w.name} is lost: no heartbeat for 10 s; its task goes to another`, w.was ?? null, w.name);
    return w.name;
  }

  retry(tasks) {
    for (const t of tasks) {
      if (!'fq'.includes(this.tasks[t]?.s ?? '')) continue;
      this.set(t, { s: 'r', p: 0, v: null, w: '' });
      this.say('info', 'retried by hand', t);
    }
    this.ended = null;
    this.free();
  }

  doneShare() { return this.counts().done / this.tasks.length; }
  counts() {
    const by = { w: 0, r: 0, l: 0, d: 0, f: 0, q: 0 };
    for (const task of this.tasks) by[task.s] += 1;
    return { waiting: by.w, ready: by.r, leased: by.l, done: by.d, failed: by.f, quarantined: by.q };
  }
  splats() {
    // Leaves of what is finished: a block counts unless a child of it has begun to.
    const covered = new Set();
    this.tasks.forEach((task, t) => { if (task.n > 0 && this.parents[t] != null) covered.add(this.parents[t]); });
    return this.tasks.reduce((sum, task, t) => sum + (covered.has(t) ? 0 : task.n), 0);
  }
  state() {
    if (this.cancelled) return 'cancelled';
    const c = this.counts();
    if (c.leased || c.ready) return this.paused ? 'paused' : 'running';
    return c.failed || c.quarantined || c.waiting ? 'incomplete' : 'done';
  }

  job() {
    const counts = this.counts();
    const n = this.plan.blocks.level.length;
    const all = this.tasks.slice(0, n).reduce((sum, t) => sum + t.steps, 0);
    const done = Math.round(this.tasks.slice(0, n).reduce((sum, t) => sum + (t.steps * t.p) / 1000, 0));
    const share = done / all;
    const elapsed = (this.shared.now() - this.started) / 1000;
    const state = this.state();
    const left = share > 0.05 ? (elapsed * (1 - share)) / share : null;
    const known = state === 'running' && left !== null;
    const q = counts.done > 0 ? 27.1 + 2 * share : null;
    return {
      id: this.id, name: this.shape.name, plan: `${(this.shape.seed * 2654435761 >>> 0).toString(16).padStart(8, '0')}c0ffee`, state,
      phase: state === 'done' ? 'done' : share < 1 ? 'train' : 'evaluate', backend: 'auto', priority: this.priority, weight: 1,
      blocks: n, evaluations: this.plan.evaluations, detections: this.plan.detections, levels: this.plan.levels, counts,
      started_unix_ms: this.started, ended_unix_ms: this.ended, steps_done: done, steps_all: all, photos_done: 0, photos_all: 0,
      splats: this.splats(), cpu_seconds: Math.round(this.cpu),
      eta_seconds: known ? [Math.round(left * 0.85), Math.round(left * 1.25)] : null,
      eta_note: known ? 'from the speed of the last 10 minutes' : state === 'running' ? 'unknown until 5 % of the steps are done' : '',
      psnr: q && +q.toFixed(2), ssim: q && +(q / 32).toFixed(3), perceptual: q && +(q * 2.1).toFixed(1), model: counts.done > 0,
    };
  }
}

export function hash(...keys) {
  let h = 2166136261;
  for (const k of keys) h = Math.imul(h ^ (k + 0x9e37), 16777619);
  h = Math.imul(h ^ (h >>> 15), 2246822519);
  return ((h ^ (h >>> 13)) >>> 0) / 4294967296;
}

function parents(plan) {
  const at = new Map();
  const { level, x, y } = plan.blocks;
  level.forEach((l, t) => at.set(`${l}/${x[t]}/${y[t]}`, t));
  return level.map((l, t) => (l === 0 ? null : at.get(`${l - 1}/${x[t] >> 1}/${y[t] >> 1}`) ?? null));
}

function makePlan(shape, rnd) {
  const blocks = { level: [], x: [], y: [], steps: [], budget: [], rho_metres: [], views: [] };
  // The city: most of the square, without its corners; finer where the streets are dense.
  const inside = (l, x, y) => {
    const e = 1 / 2 ** l;
    const dx = (x + 0.5) * e - 0.5;
    const dy = (y + 0.5) * e - 0.5;
    return l < 2 || (dx * 1.0) ** 2 + (dy * 1.15) ** 2 < (l < shape.levels - 1 ? 0.235 : shape.fine ?? 0.17);
  };
  for (let l = 0; l < shape.levels; l += 1) {
    for (let y = 0; y < 2 ** l; y += 1) for (let x = 0; x < 2 ** l; x += 1) {
      if (blocks.level.length >= shape.blocks || !inside(l, x, y)) continue;
      blocks.level.push(l); blocks.x.push(x); blocks.y.push(y);
      blocks.steps.push(1500 + 250 * l);
      blocks.budget.push(Math.round((20000 + 40000 * rnd()) / 2 ** Math.max(0, l - 3)));
      blocks.rho_metres.push(0.64 / 2 ** l);
      blocks.views.push(Math.round(30 + 100 * rnd()));
    }
  }
  const cameras = { x: [], y: [], test: [] };
  const streets = 9;
  for (let i = 0; i < 1800; i += 1) {
    const street = (Math.floor(rnd() * streets) - (streets - 1) / 2) * 0.075;
    const along = (rnd() - 0.5) * 0.75;
    const [u, v] = i % 2 ? [street, along] : [along, street];
    cameras.x.push(+((u + 0.012 * (rnd() - 0.5)) * EDGE).toFixed(2));
    cameras.y.push(+((v * 0.9 + 0.012 * (rnd() - 0.5)) * EDGE).toFixed(2));
    cameras.test.push(i % 8 === 0 ? 1 : 0);
  }
  const points = { x: [], y: [] };
  while (points.x.length < shape.points) {
    const u = rnd() - 0.5;
    const v = rnd() - 0.5;
    const near = Math.min(Math.abs(((u + 1) % 0.075) - 0.0375), Math.abs(((v + 1) % 0.075) - 0.0375));
    if (u * u + v * v * 1.3 > 0.22 || rnd() < near * 22) continue;
    points.x.push(+(u * EDGE).toFixed(2));
    points.y.push(+(v * EDGE).toFixed(2));
  }
  return {
    plan: 'abad1dea', name: shape.name, levels: shape.levels, root: { x: -EDGE / 2, y: -EDGE / 2, edge: EDGE }, north_up: true,
    geo: { latitude: 55.7047, longitude: 13.191 }, blocks, evaluations: shape.evaluations ?? 4, detections: 0, cameras, points,
  };
}

