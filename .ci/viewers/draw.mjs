// Draws views of a folder that .ci/check-viewers.sh laid out: node draw.mjs FOLDER OUT CHROMIUM VIEWER, where VIEWER.html is a page of the folder.
// A page sets window.ready, then draws the view of a frame of cameras.json by window.draw(index), which returns a PNG as base64 and figures.
import { createReadStream, readFileSync, statSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join, normalize, resolve } from "node:path";
import { createRequire } from "node:module";

const [given, out, executablePath, viewer] = process.argv.slice(2);
const folder = resolve(given);
const { chromium } = createRequire(join(folder, "package.json"))("playwright-core");
const types = {
    ".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript", ".json": "application/json", ".css": "text/css",
    ".wasm": "application/wasm", ".webp": "image/webp",
};

/** Serves files of the folder, and ranges of them: RAD is read by ranges. */
const server = createServer((request, response) => {
    const path = join(folder, normalize(decodeURIComponent(new URL(request.url, "http://localhost").pathname)));
    const file = statSync(path, { throwIfNoEntry: false });
    if (!file?.isFile()) return response.writeHead(404).end();
    const headers = { "content-type": types[extname(path)] ?? "application/octet-stream", "accept-ranges": "bytes" };
    const range = /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? "");
    const start = Number(range?.[1] ?? 0);
    const end = Math.min(range?.[2] ? Number(range[2]) : Infinity, file.size - 1);
    if (range) headers["content-range"] = `bytes ${start}-${end}/${file.size}`;
    response.writeHead(range ? 206 : 200, { ...headers, "content-length": end - start + 1 });
    createReadStream(path, { start, end }).pipe(response);
}).listen(0, "127.0.0.1");

const { frames } = JSON.parse(readFileSync(join(folder, "cameras.json")));
const browser = await chromium.launch({
    executablePath,
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--no-first-run"],
});
const page = await browser.newPage({ viewport: { width: frames[0].w, height: frames[0].h } });
page.on("pageerror", (error) => console.error(String(error)));
page.on("console", (message) => ["error", "warning"].includes(message.type()) && process.env.VERBOSE && console.error(message.text()));
await page.goto(`http://127.0.0.1:${server.address().port}/${viewer}.html${process.env.QUERY ?? ""}`);
await page.waitForFunction(() => window.ready, undefined, { timeout: 60_000 });
for (const index of frames.keys()) {
    const { png, ...figures } = await page.evaluate((index) => window.draw(index), index);
    writeFileSync(join(out, `${viewer}-${index}.png`), Buffer.from(png, "base64"));
    console.log(JSON.stringify({ viewer, index, ...figures }));
}
await browser.close();
server.close();
