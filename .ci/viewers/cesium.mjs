// Draws views of a folder that .ci/check-viewers.sh laid out: node cesium.mjs FOLDER OUT CHROMIUM SCREEN_ERROR INDEX...
import { createReadStream, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { createRequire } from "node:module";

const [folder, out, executablePath, screenError, ...indices] = process.argv.slice(2);
const { chromium } = createRequire(join(folder, "package.json"))("playwright-core");
const types = { ".html": "text/html", ".js": "text/javascript", ".json": "application/json", ".css": "text/css", ".wasm": "application/wasm" };
const server = createServer((request, response) => {
    const path = join(folder, normalize(decodeURIComponent(new URL(request.url, "http://localhost").pathname)));
    const stream = createReadStream(path);
    stream.once("open", () => response.writeHead(200, { "content-type": types[extname(path)] ?? "application/octet-stream" }));
    stream.once("error", () => response.writeHead(404).end());
    stream.pipe(response);
}).listen(0, "127.0.0.1");
const { frames } = JSON.parse(readFileSync(join(folder, "cameras.json")));
const browser = await chromium.launch({
    executablePath,
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking", "--no-first-run"],
});
const page = await browser.newPage({ viewport: { width: frames[0].w, height: frames[0].h } });
page.on("pageerror", (error) => console.error(String(error)));
await page.goto(`http://127.0.0.1:${server.address().port}/cesium.html`);
await page.waitForFunction(() => window.ready);
for (const index of indices.map(Number)) {
    const { png, ...figures } = await page.evaluate(([index, screenError]) => window.draw(index, screenError), [index, Number(screenError)]);
    writeFileSync(join(out, `${index}.png`), Buffer.from(png, "base64"));
    console.log(JSON.stringify({ index, ...figures }));
}
await browser.close();
server.close();
