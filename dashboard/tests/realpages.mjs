// What each page must show of a job that has ended, in one theme: content, no error, no failed request, nothing that axe objects to.
import assert from 'node:assert/strict';
import { shot, violations } from './helper.mjs';

const text = (page, selector) => page.locator(selector).first().innerText();

const PAGES = [
  ['overview', '', async (page) => {
    await page.waitForSelector('.map canvas[data-frames]');
    assert.match(await text(page, '.kpis'), /5 \/ 5[\s\S]*\d+\.\d\d dB/);
    const feed = await text(page, '.feed');
    assert.match(feed, /done: [0-9a-f]{12}…/);
    assert.ok(await page.evaluate(() => [...document.querySelectorAll('.panel')].every((p) => p.scrollWidth <= p.clientWidth + 1)), 'nothing overflows its panel');
  }],
  ['blocks', 'blocks?by=psnr', async (page) => {
    await page.waitForSelector('.grid-row');
    assert.match(await text(page, '.grid'), /0\/0\/0[\s\S]*1\/\d\/\d/);
    assert.match(await text(page, '.legend'), /dB/);
  }],
  // A block that ended while the coordinator was away has no curve: its reports went nowhere.
  ['block', async (url) => {
    for (const t of [1, 2, 3, 4]) if ((await fetch(`${url}/api/jobs/2/tasks/${t}`).then((r) => r.json())).curve.step.length > 5) return `block/${t}`;
    throw new Error('no block has a curve');
  }, async (page) => {
    await page.waitForSelector('.uplot canvas');
    assert.match(await text(page, 'main'), /Block 1\/\d\/\d[\s\S]*attempt \d/);
    await page.waitForSelector('.log div');
  }],
  ['compare', 'compare', async (page) => { await page.waitForSelector('svg.pareto .mark'); }],
  ['cluster', 'cluster', async (page) => {
    await page.waitForSelector('.grid-row');
    assert.match(await text(page, '.grid'), /four/);
    const painted = await page.locator('section[aria-label="What they did"] canvas').evaluate((c) => {
      const d = c.getContext('2d').getImageData(0, 0, c.width, c.height - 60).data;
      let n = 0;
      for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 200 && Math.max(d[i], d[i + 1], d[i + 2]) - Math.min(d[i], d[i + 1], d[i + 2]) > 60) n += 1;
      return n;
    });
    assert.ok(painted > 40, `${painted} coloured pixels in the workers' bars`);
  }],
  ['events', 'events', async (page) => {
    await page.waitForSelector('[data-testid=events] li');
    // The log outlives the coordinator, which has been killed since: it has what happened before and after.
    const told = await text(page, '[data-testid=events]');
    for (const what of [/finished: Done/, /another coordinator leads/, /submitted: plan/]) assert.match(told, what);
  }],
  ['downloads', 'downloads', async (page) => { await page.waitForSelector('main table, main .empty'); }],
  ['settings', 'settings', async (page) => { assert.match(await text(page, 'main'), /a coordinator/); }],
];

export async function everyPage({ watched, url, theme, shows }) {
  const page = await watched(`${url}/#/`, { colorScheme: theme });
  for (const [name, path, check] of PAGES) {
    await shows(`page ${name}, ${theme}`, async () => {
      await page.goto(`${url}/#/${typeof path === 'string' ? path : await path(url)}`);
      await page.waitForSelector('h1:not(:empty)', { state: 'attached' });
      await check(page);
      await shot(page, `real-${name}-${theme}`);
      assert.deepEqual(await violations(page), []);
      assert.deepEqual(page.problems.splice(0), []);
      return 'axe has no serious objection';
    });
  }
  await shows(`a held-out view rendered by the browser, ${theme}`, async () => {
    const { views } = await fetch(`${url}/api/jobs/2/views`).then((r) => r.json());
    const view = views.find((v) => v.psnr !== null && v.task != null && !v.render);
    await page.goto(`${url}/#/block/${view.task}`);
    await page.getByRole('button', { name: 'Render here' }).click();
    await page.waitForFunction(() => /mean error \d/.test(document.querySelector('.triple').textContent), undefined, { timeout: 70000 });
    await shot(page, `real-rendered-${theme}`);
    assert.deepEqual(page.problems.splice(0), []);
    const error = Number(/mean error ([\d.]+)/.exec(await text(page, '.triple'))[1]);
    // Upside down or elsewhere it is 60 and more.
    assert.ok(error < 45, `mean error ${error}`);
    return `mean error ${error} of 255 where the evaluation had ${view.psnr.toFixed(1)} dB`;
  });
  await page.context().close();

  await shows(`page viewer, ${theme}`, async () => {
    // A software GPU draws: the window is small.
    const viewer = await watched(`${url}/#/settings`, { colorScheme: theme, viewport: { width: 760, height: 560 } });
    const asked = new Set();
    viewer.on('response', (r) => { const m = /\/blocks\/([0-9a-f]+)\.(spz|rad)/.exec(r.url()); if (m && r.ok()) asked.add(m[1]); });
    await viewer.goto(`${url}/#/view`);
    await viewer.waitForFunction(() => { const h = document.querySelector('[data-testid=hud]')?.dataset; return Number(h?.shown) > 500 && h.pending === '0'; }, undefined, { timeout: 40000 });
    await viewer.waitForTimeout(2500);
    await shot(viewer, `real-viewer-${theme}`);
    const seen = await colours(viewer);
    assert.ok(seen.distinct > 200 && seen.lit > 0.15, JSON.stringify(seen));
    assert.ok(asked.size >= 4, `${asked.size} blocks were asked for`);
    assert.deepEqual(await violations(viewer), []);
    assert.deepEqual(viewer.problems, []);
    await viewer.context().close();
    return `${asked.size} blocks asked for, ${seen.distinct} colours, ${Math.round(100 * seen.lit)} % of the picture is not its background`;
  });
}

/** How many colours the viewer's picture has, and which share of it is not background. Read from the screenshot: WebGL keeps no pixels. */
export async function colours(page) {
  const png = (await page.locator('.viewer').screenshot()).toString('base64');
  return page.evaluate(async (data) => {
    const image = new Image();
    image.src = `data:image/png;base64,${data}`;
    await image.decode();
    const g = new OffscreenCanvas(image.width, image.height).getContext('2d');
    g.drawImage(image, 0, 0);
    const d = g.getImageData(0, 0, image.width, image.height).data;
    const found = new Set();
    let lit = 0;
    for (let i = 0; i < d.length; i += 4) {
      found.add((d[i] >> 2) * 4096 + (d[i + 1] >> 2) * 64 + (d[i + 2] >> 2));
      if (Math.abs(d[i] - 16) + Math.abs(d[i + 1] - 20) + Math.abs(d[i + 2] - 24) > 30) lit += 1;
    }
    return { distinct: found.size, lit: lit / (d.length / 4) };
  }, png);
}
