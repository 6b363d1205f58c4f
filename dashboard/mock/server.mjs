#!/usr/bin/env node
// The contract of the server, simulated, for development and tests:
//   node mock/server.mjs [--scenario demo|big|failed|several|empty] [--port N] [--seed N] [--rad FILE]
// --rad: a .rad file (plat export MODEL --to rad) that is served for every block, to try the viewer's paged format.
// POST /mock/lose-worker, /mock/coordinator?reachable=0|1, /mock/drop (cuts streams), GET /mock/seen (what was asked of it).
import { createServer } from 'node:http';
import { readFileSync } from 'node:fs';
import { extname, join, normalize } from 'node:path';
import { Sim, TICK_MILLIS, hash } from './world.mjs';
import { picture, spz } from './pictures.mjs';

const option = (name, fallback) => {
  const at = process.argv.indexOf(`--${name}`);
  return at < 0 ? fallback : process.argv[at + 1];
};
const scenario = option('scenario', 'demo');
const seed = Number(option('seed', '7'));
const dist = join(import.meta.dirname, '..', 'dist');
const RING = 600;
const rad = option('rad', null) && readFileSync(option('rad', null));

let ticks = 0;
let seq = 0;
let behind = 0; // simulated time runs ahead of the wall clock while the scenario is prepared
const seen = { posts: [], resumed: [], snapshots: 0 };
const log = [];
const fresh = [];
const shared = {
  now: () => Date.now() - behind,
  log: (e) => { const event = { number: log.length + 1, unix_ms: shared.now(), ...e }; log.push(event); fresh.push(event); },
};
let server = {
  version: '0.1.0-mock', kind: scenario === 'demo' ? 'train' : 'coordinator', controls: true, store_url: scenario === 'demo' ? null : 's3://city/plat',
  coordinator: scenario === 'demo' ? null : { url: 'http://127.0.0.1:7070', reachable: true, silent_millis: 200 },
};
let serverChanged = false;

const shapes = {
  demo: [{ name: 'old-town', blocks: 240, levels: 5, workers: 6, seed, failures: 0.02, speed: 40, points: 9000, ahead: 560 }],
  big: [{ name: 'metropolis', blocks: 10000, levels: 8, workers: 64, seed, failures: 0.01, speed: 260, points: 20000, ahead: 500, evaluations: 12, fine: 0.235 }],
  failed: [{ name: 'harbour', blocks: 70, levels: 5, workers: 5, seed, failures: 0.42, speed: 60, points: 6000, ahead: 900 }],
  several: [
    { name: 'old-town', blocks: 40, levels: 4, workers: 3, seed, failures: 0.03, speed: 40, points: 4000, ahead: 400 },
    { name: 'harbour', blocks: 60, levels: 5, workers: 4, seed: seed + 1, failures: 0.05, speed: 20, points: 4000, ahead: 120 },
    { name: 'airport', blocks: 50, levels: 4, workers: 0, seed: seed + 2, failures: 0, speed: 20, points: 4000, ahead: 0 },
  ],
  empty: [],
}[scenario];
if (!shapes) throw new Error(`--scenario ${scenario}: one of demo, big, failed, several, empty`);

behind = Math.max(0, ...shapes.map((s) => s.ahead)) * TICK_MILLIS;
const sims = shapes.map((shape, i) => new Sim(i + 1, shape, shared));
sims.forEach((sim, i) => sim.workers.forEach((w) => { w.name = `${'abc'[i]}-${w.name}`; }));
for (let t = Math.max(0, ...shapes.map((s) => s.ahead)); t > 0; t -= 1) {
  sims.forEach((sim) => { if (t <= sim.shape.ahead) sim.tick(); });
  behind -= TICK_MILLIS;
}
sims.forEach((sim) => sim.changed.clear());
fresh.length = 0;

const workers = () => sims.flatMap((sim) => sim.workers.map(({ slow: _s, was: _w, ...w }) => w));
const snapshot = () => ({ seq, now_unix_ms: shared.now(), server, jobs: sims.map((s) => s.job()), workers: workers(), events: log.slice(-200) });
const change = (sim, t) => { const { s, p, n, l, v, w, a } = sim.tasks[t]; return { t, s, p, n, l, v, w, a }; };

const ring = [];
const streams = new Set();
function tick() {
  ticks += 1;
  for (const sim of sims) sim.tick();
  const tasks = {};
  for (const sim of sims) if (sim.changed.size) tasks[sim.id] = [...sim.changed].map((t) => change(sim, t));
  const jobs = sims.filter((s) => s.changed.size).map((s) => s.job());
  sims.forEach((s) => s.changed.clear());
  if (!jobs.length && !serverChanged && !fresh.length) {
    if (ticks % 2 === 0) send('tick', null, { now_unix_ms: shared.now() });
    return;
  }
  seq += 1;
  const delta = { now_unix_ms: shared.now(), server: serverChanged ? server : null, jobs, workers: workers(), events: fresh.splice(0), tasks };
  serverChanged = false;
  ring.push([seq, delta]);
  if (ring.length > RING) ring.shift();
  send('delta', seq, delta);
}
const frame = (type, id, data) => `event: ${type}\n${id === null ? '' : `id: ${id}\n`}data: ${JSON.stringify(data)}\n\n`;
function send(type, id, data) {
  const text = frame(type, id, data);
  for (const stream of streams) stream.write(text);
}
setInterval(tick, TICK_MILLIS);

const results = () => ['old-town', 'fox'].flatMap((scene, s) => {
  const base = { scene, commit: '99ea843c5c91', machine: 'AMD EPYC, 2 cores', backend: 'cpu-avx512', workers: 1, downscale: 1, lpips: null, source: null, split: `${scene} every 8th`, own: false };
  const runs = [[60, 24.9], [140, 26.4], [200, 25.8], [420, 27.7], [900, 28.3], [1600, 28.1], [3000, 28.9]].map(([cpu, psnr], i) => ({
    ...base, label: `plat ${['whole', 'tree', 'flat'][i % 3]} ${i}`, steps: 400 * (i + 1), budget: 14000 * (i + 1), splats: 12000 * (i + 1), cpu_seconds: cpu * (s + 1),
    wall_seconds: cpu * 0.6 * (s + 1), psnr: psnr - s * 0.7, ssim: psnr / 31, perceptual: (psnr - 20) * 8, own: i === 5,
    curve: [0.2, 0.5, 1].map((f) => ({ cpu_seconds: cpu * f * (s + 1), psnr: psnr - s * 0.7 - 3 * (1 - f), splats: 9000 * (i + 1) })),
  }));
  runs.push({ ...base, label: 'another split', split: `${scene} every 10th`, cpu_seconds: 300, wall_seconds: 210, psnr: 29.6, ssim: 0.93, perceptual: 70, splats: 50000, steps: 3000, budget: 50000, curve: [] });
  runs.push({ ...base, label: 'published A', source: 'A. Author et al., 2024, table 3', commit: null, machine: '1 GPU', backend: null, cpu_seconds: 1200, wall_seconds: 800, psnr: 28.6, ssim: 0.9, perceptual: null, splats: 1e6, steps: 30000, budget: null, curve: [] });
  return runs;
});

function taskDetail(sim, t) {
  const { plan } = sim;
  const task = sim.tasks[t];
  const n = plan.blocks.level.length;
  const [l, x, y] = [plan.blocks.level[t], plan.blocks.x[t], plan.blocks.y[t]];
  const neighbours = t < n ? plan.blocks.level.flatMap((m, u) => (m === l && Math.abs(plan.blocks.x[u] - x) + Math.abs(plan.blocks.y[u] - y) === 1 ? [u] : [])) : [];
  const share = Array.from({ length: 21 }, (_, i) => i / 20);
  const loss = (f) => 0.03 + 0.02 * (l ?? 0) + 0.35 * Math.exp(-5 * f);
  const column = (i) => task.curve.map((row) => row[i]);
  return {
    task: t, block: t < n ? `${l}/${x}/${y}` : null, kind: t < n ? 'train' : 'evaluate', state: task.s, steps: task.steps, budget: plan.blocks.budget[t] ?? 0,
    rho_metres: plan.blocks.rho_metres[t] ?? 0, memory_bytes: 1.6e9, parent: t < n ? sim.parents[t] : null, neighbours, attempts: task.attempts,
    curve: { attempt: column(0), step: column(1), loss: column(2), splats: column(3), cpu_seconds: column(4), wall_seconds: column(5) },
    fleet: { share, loss: share.map((f) => [loss(f) * 0.85, loss(f), loss(f) * 1.3]), splats: share.map((f) => [8000, 16000, 26000].map((b) => b * (0.3 + 0.7 * f))) },
    psnr: task.psnr,
  };
}

function views(sim) {
  return Array.from({ length: 24 }, (_, v) => {
    const yaw = (v / 24) * 2 * Math.PI;
    const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
    const at = [300 * Math.cos(v), 260 * Math.sin(v * 1.7), 12];
    // Columns: right, down, forward; the camera looks along (c, s, -0.1).
    return {
      view: v, name: `${String(v * 9).padStart(6, '0')}.jpg`, width: 320, height: 200, test: v % 3 === 0, photo: true,
      camera: { fx: 260, fy: 260, cx: 160, cy: 100, world_from_camera: [s, 0, c, at[0], -c, 0, s, at[1], 0, -1, 0, at[2], 0, 0, 0, 1] },
      psnr: v % 3 ? null : +(22 + 9 * hash(v, 3)).toFixed(2), ssim: v % 3 ? null : +(0.7 + 0.25 * hash(v, 4)).toFixed(3), perceptual: v % 3 ? null : +(30 + 50 * hash(v, 5)).toFixed(1),
      street: v % 2 === 0, task: v % 5,
    };
  });
}

/** Faces between neighbours of a level, but for every fifth block's, which were not measured. */
function faces({ level, x, y }) {
  const names = level.map((l, t) => `${l}/${x[t]}/${y[t]}`);
  const all = new Set(names);
  const beside = (t) => [`${level[t]}/${x[t] + 1}/${y[t]}`, `${level[t]}/${x[t]}/${y[t] + 1}`].filter((n) => all.has(n));
  return names.flatMap((a, t) => (t % 5 === 4 ? [] : beside(t).map((b, i) => ({ a, b, jump: +(10 * hash(t, 6 + i)).toFixed(2), step: 1 }))));
}

function model(sim) {
  const { root, blocks } = sim.plan;
  return {
    seq, root, centre: [0, 0, 0], sh_degree: 0, antialiased: true, formats: rad ? ['rad', 'spz'] : ['spz'], turn: [0, 0, 0, 1], faces: faces(blocks),
    blocks: blocks.level.map((l, t) => {
      const e = root.edge / 2 ** l;
      const [x0, y0] = [root.x + blocks.x[t] * e, root.y + blocks.y[t] * e];
      const done = sim.tasks[t].s === 'd';
      return { block: `${l}/${blocks.x[t]}/${blocks.y[t]}`, task: t, artefact: done ? `${sim.id}aa${t.toString(16).padStart(6, '0')}` : null, splats: Math.min(4000, sim.tasks[t].n || 3000), rho_metres: blocks.rho_metres[t], box: done ? [x0, y0, 0, x0 + e, y0 + e, 35] : null, backdrop: false };
    }),
  };
}

// The strictest policy that the pages need: Spark's workers are inlined in its chunk, and it fetches blobs.
const POLICY = "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self' blob:; connect-src 'self' data: blob:; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'";
const types = { '.html': 'text/html; charset=utf-8', '.js': 'text/javascript', '.css': 'text/css', '.txt': 'text/plain; charset=utf-8', '.wasm': 'application/wasm' };
function asset(path, request, response) {
  const file = normalize(path === '/' ? '/index.html' : path).replace(/^(\.\.[/\\])+/, '');
  try {
    const encoding = /\bbr\b/.test(request.headers['accept-encoding'] ?? '') && types[extname(file)] && extname(file) !== '.txt' ? 'br' : null;
    const bytes = readFileSync(join(dist, file + (encoding ? '.br' : '')));
    response.writeHead(200, { 'content-type': types[extname(file)] ?? 'application/octet-stream', 'content-security-policy': POLICY, ...(encoding && { 'content-encoding': encoding }) });
    response.end(bytes);
  } catch {
    fail(response, 404, `${path}: no such file`);
  }
}
function ranged(bytes, request, response) {
  const [, from, to] = /bytes=(\d+)-(\d*)/.exec(request.headers.range ?? '') ?? [];
  if (from === undefined) return response.end(bytes);
  const last = Math.min(bytes.length - 1, to ? Number(to) : bytes.length - 1);
  response.writeHead(206, { 'content-type': 'application/octet-stream', 'content-range': `bytes ${from}-${last}/${bytes.length}`, 'content-length': last - from + 1 });
  response.end(bytes.subarray(Number(from), last + 1));
}

const fail = (response, status, error) => { response.writeHead(status, { 'content-type': 'application/json' }); response.end(JSON.stringify({ error })); };

function stream(request, response) {
  response.writeHead(200, { 'content-type': 'text/event-stream', 'cache-control': 'no-store' });
  const last = Number(request.headers['last-event-id'] ?? NaN);
  const known = ring.length && last >= ring[0][0] - 1 && last <= seq;
  if (known) {
    const missed = ring.filter(([id]) => id > last);
    seen.resumed.push({ last, missed: missed.length });
    response.write(`retry: 500\n\n${missed.map(([id, d]) => frame('delta', id, d)).join('')}`);
  } else {
    seen.snapshots += 1;
    response.write(`retry: 500\n\n${frame('snapshot', seq, snapshot())}`);
  }
  streams.add(response);
  response.on('close', () => streams.delete(response));
}

async function body(request) {
  let text = '';
  for await (const part of request) text += part;
  return text ? JSON.parse(text) : {};
}

createServer(async (request, response) => {
  const url = new URL(request.url, 'http://mock');
  const path = url.pathname;
  const json = (value) => { response.writeHead(200, { 'content-type': 'application/json', 'cache-control': 'no-store' }); response.end(JSON.stringify(value)); };
  const image = (bytes) => { response.writeHead(200, { 'content-type': 'image/png' }); response.end(bytes); };
  if (path === '/api/events') return stream(request, response);
  if (path === '/api/snapshot') return json(snapshot());
  if (path === '/api/results') return json({ results: results() });
  if (path === '/api/downloads') return json({ files: sims.length ? [{ name: 'merged.ply', path: 'merged.ply', bytes: 312345678, blake3: 'ab'.repeat(32) }, { name: 'model.spz', path: 'model.spz', bytes: 23456789, blake3: null }] : [] });
  if (path === '/healthz') return response.end('ok');
  if (path === '/mock/seen') return json(seen);
  if (path === '/mock/lose-worker') return json({ lost: sims[0].lose(url.searchParams.get('name')) });
  if (path === '/mock/drop') { for (const s of streams) s.destroy(); return json({}); }
  if (path === '/mock/coordinator') {
    const reachable = url.searchParams.get('reachable') === '1';
    server = { ...server, coordinator: { url: 'http://127.0.0.1:7070', reachable, silent_millis: reachable ? 200 : 42000 } };
    serverChanged = true;
    return json({});
  }
  const [, id, what, argument] = path.match(/^\/api\/jobs\/(\d+)\/([a-z]+)(?:\/?([^/]*))$/) ?? [];
  const sim = sims.find((s) => s.id === Number(id));
  if (!sim) return path.startsWith('/api/') ? fail(response, 404, `${path}: no such job`) : asset(path, request, response);
  const task = Number(argument);
  switch (what) {
    case 'plan': return json(sim.plan);
    case 'tasks':
      if (argument) return sim.tasks[task] ? json(taskDetail(sim, task)) : fail(response, 404, `job ${id} has no task ${argument}`);
      return json({
        seq, state: sim.tasks.map((t) => t.s).join(''), progress: sim.tasks.map((t) => t.p), splats: sim.tasks.map((t) => t.n), loss: sim.tasks.map((t) => t.l),
        speed: sim.tasks.map((t) => t.v), worker: sim.tasks.map((t) => t.w), attempt: sim.tasks.map((t) => t.a), psnr: sim.tasks.map((t) => t.psnr),
      });
    case 'log': {
      const of = url.searchParams.get('task');
      const after = Number(url.searchParams.get('after') ?? 0);
      return json({ lines: log.filter((e) => e.job === sim.id && e.number > after && (of === null || e.task === Number(of))).slice(-1000) });
    }
    case 'curve': return json(sim.curve);
    case 'views': return json({ views: views(sim) });
    case 'photos': return image(picture(Number.parseInt(argument, 10)));
    case 'model': return json(model(sim));
    case 'blocks': {
      if (rad && argument.endsWith('.rad')) return ranged(rad, request, response);
      if (!argument.endsWith('.spz')) return fail(response, 404, `${argument}: the mock has .spz only`);
      const block = model(sim).blocks.find((b) => b.artefact === argument.slice(0, -4));
      if (!block) return fail(response, 404, `${argument}: no such artefact`);
      const [x0, y0, , x1] = block.box;
      response.writeHead(200, { 'content-type': 'application/octet-stream', 'cache-control': 'max-age=31536000, immutable' });
      return response.end(spz(block.task + 1, { x: x0, y: y0, edge: x1 - x0 }, block.splats));
    }
    case 'control': {
      const asked = await body(request);
      seen.posts.push({ job: sim.id, ...asked });
      if (asked.what === 'retry') sim.retry(asked.tasks ?? []);
      else if (asked.what === 'pause') sim.paused = true;
      else if (asked.what === 'resume') sim.paused = false;
      else if (asked.what === 'cancel') sim.cancelled = true;
      else if (asked.what === 'priority') sim.priority = asked.priority ?? sim.priority;
      else return fail(response, 400, `what "${asked.what}" is not known`);
      sim.changed.add(0);
      return json({});
    }
    default: return fail(response, 404, `${path}: not there`);
  }
}).listen(Number(option('port', '8080')), '127.0.0.1', function ready() {
  console.log(`mock ${scenario}: http://127.0.0.1:${this.address().port}/`);
});
