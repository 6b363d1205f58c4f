// A real job, watched through the pages while workers and the coordinator are killed:
//   PLAT=plat CAPTURE=folder node tests/real.mjs        screenshots go to PLAT_SHOTS; PAGES=dist tries this folder's pages
// Prints a line for each thing shown.
import assert from 'node:assert/strict';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { Cluster, front } from './cluster.mjs';
import { browser, open, shot, until, violations } from './helper.mjs';
import { colours, everyPage } from './realpages.mjs';

const began = Date.now();
const folder = mkdtempSync(join(tmpdir(), 'plat-real-'));
const cluster = new Cluster(folder);
const b = await browser();

async function shows(what, check) {
  const from = Date.now();
  const more = await check();
  console.log(`ok ${what}${more ? `: ${more}` : ''} (${((Date.now() - from) / 1000).toFixed(1)} s)`);
}

/** A page on which every failed request is a problem, but while the server is known to be down. */
async function watched(url, options) {
  const page = await open(b, url, options);
  page.mayFail = false;
  page.on('response', (r) => { if (r.status() >= 400 && !page.mayFail) page.problems.push(`${r.status()} ${r.url()}`); });
  page.on('requestfailed', (r) => { if (!page.mayFail && r.failure()?.errorText !== 'net::ERR_ABORTED') page.problems.push(`${r.failure()?.errorText} ${r.url()}`); });
  return page;
}

const legend = (page) => page.locator('.legend').first().innerText().then((text) => Object.fromEntries([...text.replaceAll('\n', ' ').matchAll(/([a-z]+) +(\d+)/g)].map(([, name, n]) => [name, Number(n)])));
const snapshot = () => fetch(`${cluster.pages}/api/snapshot`).then((r) => r.json());
const state = async (id = 2) => (await snapshot()).jobs.find((j) => j.id === id);
const submit = (...more) => cluster.submit(process.env.CAPTURE, '--levels', 1, '--steps', process.env.STEPS ?? 6000, ...more);
try {
  await cluster.coordinator();
  await cluster.observer();
  const url = await front(cluster.pages);
  const observed = await front(cluster.observed);
  const page = await watched(`${url}/#/`);
  const second = await watched(`${observed}/#/`);

  await shows('without a job the page says what to type', async () => {
    await page.waitForSelector('.command');
    assert.match(await page.locator('main').innerText(), /plat submit CAPTURE --coordinator http/);
  });

  // Four blocks that wait for nothing. The one with the most work goes first: three lost workers quarantine it, and the job goes on.
  await shows('a submitted job appears, its blocks ready', async () => {
    await submit('--blocks', 'flat');
    await page.waitForSelector('.map canvas[data-frames]', { timeout: 20000 });
    const at = await legend(page);
    assert.ok(at.ready === 4 && at.done === 0, JSON.stringify(at));
    await page.waitForSelector('text=No worker is connected');
    return JSON.stringify(at);
  });

  const banner = page.waitForSelector('[data-testid=worker-lost]', { timeout: 90000 }).then(() => Date.now(), (e) => e);
  const killed = [];
  for (const name of ['one', 'two', 'three']) {
    // After its second loss the block rests for a second, in which a worker would take another.
    if (name === 'three') await page.waitForTimeout(1800);
    await shows(`worker ${name} trains until it is killed`, async () => {
      cluster.worker(name);
      await page.waitForFunction(() => /(^|\D)[1-9]\d* running/.test(document.querySelector('.kpi small').textContent), undefined, { timeout: 30000 });
      // A loss counts against the task once the worker has reported.
      await until('the worker reports steps', async () => {
        const { workers } = await snapshot();
        return workers.some((w) => w.name === name && w.state === 'busy' && w.steps_per_second > 0);
      });
      await cluster.end(name);
      killed.push(Date.now());
      await page.waitForFunction(() => /^0 running/.test(document.querySelector('.kpi small').textContent), undefined, { timeout: 20000 });
    });
  }

  await shows('the block is quarantined, and needs attention', async () => {
    const row = page.locator('[data-testid=attention] li', { has: page.getByRole('button', { name: 'Retry' }) });
    await row.waitFor({ timeout: 30000 });
    await shot(page, 'real-failed');
    const text = await row.innerText();
    assert.match(text, /Failed/);
    return text.split('\n').slice(1).join(' ');
  });

  await shows('the banner of a lost worker', async () => {
    const at = await banner;
    if (at instanceof Error) throw at;
    const text = await page.locator('[data-testid=worker-lost]').innerText();
    assert.match(text, /Worker \w+ is lost|\d workers are lost/);
    await shot(page, 'real-worker-lost');
    assert.deepEqual(await violations(page), []);
    return `${((at - killed[0]) / 1000).toFixed(0)} s after the first was killed: ${text.split('.')[0]}`;
  });

  await shows('the button Retry brings it back', async () => {
    await page.locator('[data-testid=attention]').getByRole('button', { name: 'Retry' }).click();
    cluster.worker('four');
    await page.waitForFunction(() => /(^|\D)[1-9]\d* running/.test(document.querySelector('.kpi small').textContent), undefined, { timeout: 20000 });
    const at = await until('progress after the retry', async () => { const l = await legend(page); return l.running >= 1 && l.quarantined === 0 && l; });
    return JSON.stringify(at);
  });

  await shows('the button Cancel', async () => {
    await page.getByRole('button', { name: 'Cancel job' }).click();
    await page.getByRole('button', { name: 'Cancel it' }).click();
    await page.waitForFunction(() => /cancelled/.test(document.querySelector('.bar').textContent));
    assert.equal((await state(1)).state, 'cancelled');
    cluster.worker('five');
  });

  await shows('a second job begins, and the page turns to it', async () => {
    await submit('--evaluate');
    await until('the page shows job 2', async () => (await page.locator('.bar select').inputValue()) === '2', 20);
    await page.waitForFunction(() => /(^|\D)[1-9]\d* running/.test(document.querySelector('.kpi small').textContent), undefined, { timeout: 30000 });
  });

  await shows('the buttons Pause and Resume', async () => {
    await page.getByRole('button', { name: 'Pause job' }).click();
    await page.waitForFunction(() => /paused/.test(document.querySelector('.bar').textContent));
    assert.equal((await state()).state, 'paused');
    await page.getByRole('button', { name: 'Resume job' }).click();
    await page.getByRole('button', { name: 'Pause job' }).waitFor();
    assert.equal((await state()).state, 'running');
  });

  await shows('the map fills: the root is done, its children run', async () => {
    const at = await until('the root done, others running', async () => { const l = await legend(page); return l.done >= 1 && l.running >= 1 && l; }, 90);
    await shot(page, 'real-running');
    return JSON.stringify(at);
  });

  await shows('the viewer draws the root while its children train', async () => {
    const viewer = await watched(`${url}/#/view?budget=20000`, { viewport: { width: 760, height: 560 } });
    await viewer.waitForFunction(() => Number(document.querySelector('[data-testid=hud]')?.dataset.shown) > 500, undefined, { timeout: 40000 });
    await shot(viewer, 'real-viewer-running');
    assert.deepEqual(viewer.problems, []);
    await viewer.context().close();
  });

  await shows('a killed coordinator: "This browser has lost the server" here, "The coordinator is silent" on the other server', async () => {
    page.mayFail = second.mayFail = true;
    await cluster.end('coordinator');
    await page.waitForSelector('[data-testid=browser-lost]', { timeout: 25000 });
    await second.waitForSelector('[data-testid=coordinator-lost]', { timeout: 25000 });
    await shot(page, 'real-browser-lost');
    await shot(second, 'real-coordinator-lost');
    assert.deepEqual(await violations(second), []);
  });

  await shows('the coordinator is back, and both banners go', async () => {
    await cluster.coordinator();
    await page.waitForSelector('[data-testid=browser-lost]', { state: 'detached', timeout: 40000 });
    await second.waitForSelector('[data-testid=coordinator-lost]', { state: 'detached', timeout: 40000 });
    page.mayFail = second.mayFail = false;
  });

  await shows('the job ends, measured', async () => {
    await page.waitForFunction(() => /\d+ \/ \d+/.test(document.querySelector('.kpi dd')?.textContent), undefined, { timeout: 20000 });
    await until('the job is done', async () => (await state())?.state === 'done', 120);
    const at = await until('all blocks done', async () => { const l = await legend(page); return l.done >= 5 && l; });
    await page.waitForFunction(() => /\d+\.\d\d dB/.test(document.querySelector('.kpis').textContent));
    assert.match(await page.locator('.bar').innerText(), /done/);
    return `${JSON.stringify(at)}, ${(await state()).psnr.toFixed(2)} dB`;
  });
  assert.deepEqual(page.problems, []);
  assert.deepEqual(second.problems, []);
  for (const p of [page, second]) await p.context().close();

  for (const theme of ['light', 'dark']) await everyPage({ watched, url, theme, shows });

  await shows('/status without JavaScript', async () => {
    const plain = await watched(`${url}/#/`, { javaScriptEnabled: false });
    assert.match(await plain.locator('noscript').innerText(), /\/status/);
    await plain.goto(`${url}/status`);
    const text = await plain.locator('body').innerText();
    assert.match(text, /done[\s\S]*\d+\.\d\d dB/);
    await shot(plain, 'real-status');
    assert.deepEqual(plain.problems, []);
  });
  console.log(`all shown in ${Math.round((Date.now() - began) / 1000)} s`);
} catch (e) {
  for (const name of ['coordinator', 'observer', 'four']) console.error(`-- log of ${name}\n${cluster.log(name)}`);
  console.error(e);
  process.exitCode = 1;
} finally {
  await b.close();
  await cluster.stop();
  rmSync(folder, { recursive: true, force: true });
}
process.exit();
