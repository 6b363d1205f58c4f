// What happens when something is lost, and what is sent when something is asked for.
import assert from 'node:assert/strict';
import { after, before, test } from 'node:test';
import { browser, mock, open, REAL, shot, violations } from './helper.mjs';

if (!REAL) {
  let b;
  before(async () => { b = await browser(); });
  after(() => b.close());
  const badge = (page, state) => page.waitForSelector(`.badge.${state}`, { timeout: 20000 });

  test('a lost worker, a lost coordinator and a lost server are three banners', async () => {
    const server = await mock('several');
    const page = await open(b, `${server.url}/#/?job=1`);
    await badge(page, 'live');
    assert.equal(await page.locator('.banner').count(), 0);
    const { lost } = await server.post('/mock/lose-worker');
    await page.waitForSelector('[data-testid=worker-lost]');
    assert.match(await page.locator('[data-testid=worker-lost]').innerText(), new RegExp(`Worker ${lost} is lost`));
    assert.match(await page.locator('[data-testid=attention]').innerText(), new RegExp(`Lost worker\\s+${lost} is silent`));
    await server.post('/mock/coordinator?reachable=0');
    await page.waitForSelector('[data-testid=coordinator-lost]');
    assert.deepEqual(await violations(page), []);
    await shot(page, 'banners');
    await server.stop();
    await badge(page, 'disconnected');
    await page.waitForSelector('[data-testid=browser-lost]');
    assert.equal(await page.evaluate(() => getComputedStyle(document.querySelector('.kpi dd.num')).fontStyle), 'italic');
    assert.deepEqual(await violations(page), []);
    await shot(page, 'disconnected');
    // The server comes back on its port: the page finds it by itself, and is right again.
    const again = await mock('several', server.port);
    await badge(page, 'live');
    await page.waitForSelector('[data-testid=coordinator-lost]', { state: 'detached' });
    assert.deepEqual(page.problems, []);
    await page.context().close();
    await again.stop();
  });

  test('a cut stream resumes by Last-Event-ID, without a second snapshot', async () => {
    const server = await mock('demo');
    const page = await open(b, `${server.url}/#/events`);
    await badge(page, 'live');
    await page.waitForTimeout(1500);
    await server.post('/mock/drop');
    await page.waitForTimeout(2500);
    const seen = await server.get('/mock/seen');
    assert.equal(seen.snapshots, 1);
    assert.equal(seen.resumed.length, 1);
    assert.ok(seen.resumed[0].last > 0);
    await badge(page, 'live');
    // No event is missing: their numbers follow each other.
    const mine = await page.$$eval('[data-testid=events] li', (rows) => rows.length);
    assert.ok(mine > 0);
    await page.context().close();
    await server.stop();
  });

  test('several tabs share one stream', async () => {
    const server = await mock('demo');
    const first = await open(b, `${server.url}/#/`);
    await badge(first, 'live');
    const second = await first.context().newPage();
    await second.goto(`${server.url}/#/blocks`);
    await second.waitForSelector('.badge.live');
    const before = await second.locator('.bar .num').first().innerText();
    await second.waitForFunction((old) => document.querySelector('.grid-row .num')?.textContent !== old, before);
    assert.equal((await server.get('/mock/seen')).snapshots, 1);
    await first.close();
    await second.waitForTimeout(1500);
    assert.equal((await server.get('/mock/seen')).snapshots, 2);
    await second.waitForSelector('.badge.live');
    await second.context().close();
    await server.stop();
  });

  test('a failed job: storms are one row, retry sends its tasks', async () => {
    const server = await mock('failed');
    const page = await open(b, `${server.url}/#/`);
    // The job's state comes first, its tasks after it, the events that name causes last.
    const storm = page.locator('[data-testid=attention] li', { hasText: /\d+ blocks (failed|quarantined), same cause/ });
    await storm.first().waitFor();
    assert.match(await page.locator('[data-testid=attention] li').first().innerText(), /^Blocked/);
    await page.waitForSelector('.map canvas[data-frames]');
    await shot(page, 'failed');
    assert.deepEqual(await violations(page), []);
    const sent = page.waitForResponse((r) => r.request().method() === 'POST');
    await storm.first().getByRole('button').click();
    assert.equal((await sent).status(), 200);
    const post = (await server.get('/mock/seen')).posts.at(-1);
    assert.equal(post.what, 'retry');
    assert.ok(post.tasks.length > 1 && post.tasks.every(Number.isInteger));
    // By the map: select by the keyboard, retry the selection.
    await page.goto(`${server.url}/#/blocks`);
    await page.waitForSelector('.map canvas[data-frames]');
    await page.focus('.map canvas');
    for (const key of ['ArrowRight', ' ', 'ArrowUp', ' ']) await page.keyboard.press(key);
    await page.waitForFunction(() => /Blocks\s+2/.test(document.querySelector('.facts')?.innerText ?? ''));
    await page.context().close();
    await server.stop();
  });

  test('several jobs: the switcher puts the job into the address', async () => {
    const server = await mock('several');
    const page = await open(b, `${server.url}/#/`);
    await page.waitForSelector('.bar select');
    await page.selectOption('.bar select', '3');
    assert.match(page.url(), /#\/\?job=3$/);
    await page.waitForFunction(() => document.querySelector('.kpi dd')?.textContent.startsWith('0 /'));
    assert.match(await page.locator('[data-testid=attention]').innerText(), /Blocked/);
    await page.click('nav >> text=Blocks');
    assert.match(page.url(), /#\/blocks\?job=3$/);
    await page.goto(`${server.url}/#/?job=9`);
    await page.waitForSelector('text=There is no job 9');
    await page.context().close();
    await server.stop();
  });

  test('no job at all: each page says what to type', async () => {
    const server = await mock('empty');
    const page = await open(b, `${server.url}/#/`);
    await page.waitForSelector('.command');
    assert.match(await page.locator('main').innerText(), /plat submit CAPTURE --coordinator http:\S+[\s\S]*plat worker --coordinator[\s\S]*plat train CAPTURE --out DIR --serve/);
    await shot(page, 'empty');
    assert.deepEqual(await violations(page), []);
    for (const [path, says] of [['blocks', 'plat submit'], ['cluster', 'plat worker'], ['view', 'plat submit'], ['events', 'Nothing has happened'], ['downloads', 'plat export'], ['compare', 'Speed']]) {
      await page.goto(`${server.url}/#/${path}`);
      await page.waitForSelector(`main >> text=${says}`);
    }
    assert.deepEqual(page.problems, []);
    await page.context().close();
    await server.stop();
  });
}
