// The dashboard of docker-compose.yml, watched while infra/chaos/run.py breaks the cluster behind it:
//   URL=https://localhost:7288 TOKEN=... node tests/compose.mjs        screenshots go to PLAT_SHOTS
// Prints `next: WORD` where the cluster is to be changed: pause (a busy worker), go on (that worker), kill (the leader), finish (nothing more).
// Reads no answer: what happened has to show on the page.
import assert from 'node:assert/strict';
import { colours } from './realpages.mjs';
import { browser, open, shot, until, violations } from './helper.mjs';

const url = process.env.URL.replace(/\/$/, '');
const access = { ignoreHTTPSErrors: true, httpCredentials: { username: 'anyone', password: process.env.TOKEN, send: 'always' } };
const next = (word) => console.log(`next: ${word}`);
const b = await browser();

try {
  const stranger = await (await b.newContext({ ignoreHTTPSErrors: true })).request.get(`${url}/api/snapshot`);
  assert.equal(stranger.status(), 401, 'without the token nothing is shown');

  const page = await open(b, `${url}/#/`, access);
  const api = (path) => page.context().request.get(url + path).then((r) => r.json());
  const running = () => page.waitForFunction(() => /(^|\D)[1-9]\d* running/.test(document.querySelector('.kpi small')?.textContent ?? ''), undefined, { timeout: 60000 });
  await page.waitForSelector('.map canvas[data-frames]', { timeout: 60000 });
  await running();
  next('pause');
  await page.waitForSelector('[data-testid=worker-lost]', { timeout: 60000 });
  await shot(page, 'compose-worker-lost');
  next('go on');
  await page.waitForSelector('[data-testid=worker-lost]', { state: 'detached', timeout: 60000 });
  const before = await api('/api/jobs/1/log?after=0');
  assert.ok(before.lines.some((line) => /granted/.test(line.what)));
  next('kill');
  const told = async () => {
    const { lines } = await api('/api/jobs/1/log?after=0');
    return lines.some((line) => /another coordinator leads/.test(line.what)) && lines;
  };
  const after = await until('the log tells of another leader', told);
  const kept = new Set(after.map((line) => `${line.task} ${line.attempt} ${line.what}`));
  assert.ok(before.lines.every((line) => kept.has(`${line.task} ${line.attempt} ${line.what}`)), 'the log of the leader before is kept');
  await page.waitForSelector('[data-testid=coordinator-lost]', { state: 'detached', timeout: 60000 });
  next('finish');
  const job = await until('the job is done', async () => (await api('/api/snapshot')).jobs.find((j) => j.id === 1 && j.state === 'done'), 150);
  const settled = () => page.waitForFunction(() => /· done/.test(document.querySelector('.bar select').textContent) && /Live/.test(document.querySelector('[data-testid=link]').textContent), undefined, { timeout: 30000 });
  await settled();
  await shot(page, 'compose-overview');
  assert.deepEqual(await violations(page), []);
  await page.goto(`${url}/#/events`);
  await page.waitForSelector('[data-testid=events] li');
  await settled();
  await shot(page, 'compose-events');
  assert.deepEqual(page.problems, []);

  const viewer = await open(b, `${url}/#/view?budget=20000`, { ...access, viewport: { width: 760, height: 560 } });
  await viewer.waitForFunction(() => Number(document.querySelector('[data-testid=hud]')?.dataset.shown) > 500, undefined, { timeout: 60000 });
  await viewer.waitForTimeout(2500);
  await shot(viewer, 'compose-viewer');
  const seen = await colours(viewer);
  assert.ok(seen.distinct > 200 && seen.lit > 0.15, JSON.stringify(seen));
  assert.deepEqual(viewer.problems, []);
  console.log(`shown: ${job.counts.done} tasks done, ${before.lines.length} lines of the log before the leader died and ${after.length} soon after, ${seen.distinct} colours in the viewer`);
} catch (e) {
  console.error(e);
  process.exitCode = 1;
} finally {
  await b.close();
}
