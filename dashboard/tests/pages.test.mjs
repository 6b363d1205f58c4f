// Each page, light and dark: real content, no error, no serious accessibility violation; a screenshot of each.
import assert from 'node:assert/strict';
import { after, before, test } from 'node:test';
import { browser, mock, open, REAL, shot, violations } from './helper.mjs';

let b;
let server;
before(async () => { b = await browser(); server = REAL ? { url: REAL, stop: async () => {} } : await mock('demo'); });
after(async () => { await b.close(); await server.stop(); });

// Page, and what must stand on it.
const PAGES = {
  overview: ['', async (page) => {
    await page.waitForFunction(() => /\d+ \/ [1-9]\d*/.test(document.querySelector('.kpi dd')?.textContent ?? ''));
    assert.match(await text(page, '.kpis'), /Held-out PSNR\s*(\d+\.\d\d dB|–)/);
    await page.waitForFunction(() => Number(document.querySelector('.map canvas')?.dataset.frames) > 0);
    assert.match(await text(page, '.legend'), /done\s+\d+/);
  }],
  blocks: ['blocks', async (page) => {
    await page.waitForSelector('.grid-row');
    assert.match(await text(page, '.grid'), /\d+\/\d+\/\d+/);
    await page.selectOption('select >> nth=1', 'psnr');
    assert.match(await text(page, '.legend'), /dB/);
  }],
  block: ['block/0', async (page) => {
    await page.waitForSelector('.uplot canvas');
    assert.match(await text(page, 'main'), /Block 0\/0\/0/);
    if (!REAL) {
      await page.getByRole('button', { name: 'Render here' }).click();
      await page.waitForFunction(() => /mean error \d+\.\d of 255/.test(document.body.textContent), undefined, { timeout: 60000 });
    }
  }],
  compare: ['compare', async (page) => {
    await page.waitForSelector('svg.pareto .mark, .empty h3');
    if (REAL) return;
    await page.locator('.mark').nth(2).locator('circle').first().hover();
    assert.match(await text(page, '.tip'), /dominated by plat tree 1: \+0\.60 dB, -30 % time/);
    for (const i of [0, 3]) await page.locator('.mark').nth(i).locator('circle').first().click();
    assert.match(await text(page, '[data-testid=diff]'), /PSNR, dB[\s\S]*\+2\.800/);
  }],
  cluster: ['cluster', async (page) => {
    await page.waitForSelector('.grid-row, .empty h3');
    if (!REAL) assert.match(await text(page, '.grid'), /busy[\s\S]*steps|busy/);
  }],
  events: ['events', async (page) => {
    await page.waitForSelector('[data-testid=events] li, .empty');
    if (REAL) return;
    await page.check('input[type=checkbox]');
    const rows = await page.$$eval('[data-testid=events] li', (r) => r.map((e) => e.textContent));
    assert.ok(rows.length > 0 && rows.every((r) => r.includes('failed')), 'only failures are left');
  }],
  downloads: ['downloads', async (page) => {
    await page.waitForSelector('main table, main .empty h3');
    if (!REAL) assert.match(await text(page, 'main'), /merged\.ply\s*312\.3 MB\s*abababababababab/);
  }],
  settings: ['settings', async (page) => {
    await page.click('text=dark');
    assert.equal(await page.evaluate(() => document.documentElement.dataset.theme), 'dark');
    await page.click('text=system');
    assert.match(await text(page, 'main'), /Version/);
  }],
};
const text = (page, selector) => page.locator(selector).first().innerText();

for (const theme of ['light', 'dark']) {
  test(`pages, ${theme}`, async (t) => {
    const page = await open(b, `${server.url}/#/`, { colorScheme: theme });
    for (const [name, [path, check]] of Object.entries(PAGES)) {
      await t.test(name, async () => {
        await page.goto(`${server.url}/#/${path}`);
        await page.waitForSelector('h1:not(:empty)', { state: 'attached' });
        await check(page);
        await shot(page, `${name}-${theme}`);
        assert.deepEqual(await violations(page), []);
        assert.deepEqual(page.problems.splice(0), []);
      });
    }
    await page.context().close();
  });
}

test('narrow and calm', async () => {
  const page = await open(b, `${server.url}/#/`, { viewport: { width: 390, height: 800 }, reducedMotion: 'reduce' });
  await page.waitForSelector('.kpi');
  assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth + 1), 'nothing scrolls sideways');
  // The badge beats once a second, unless motion is unwanted.
  for (let i = 0; i < 5; i += 1) { assert.equal(await page.locator('.badge.beat').count(), 0); await page.waitForTimeout(250); }
  await shot(page, 'narrow');
  await page.context().close();
});

test('the first page is small, and asks for no viewer', async () => {
  const page = await open(b, 'about:blank');
  const files = [];
  page.problems = [];
  page.on('response', (r) => { if (/assets|\/$/.test(r.url())) files.push(r); });
  await page.goto(`${server.url}/#/`);
  await page.waitForSelector('.kpi, .empty');
  const sizes = await Promise.all(files.map(async (r) => (await r.request().sizes()).responseBodySize));
  const bytes = sizes.reduce((a, n) => a + n, 0);
  console.log(`first page: ${files.length} files, ${bytes} bytes as sent`);
  assert.ok(bytes > 5000 && bytes <= 100000, `${bytes} bytes`);
  assert.ok(!files.some((r) => r.url().includes('stage-')));
  await page.context().close();
});
