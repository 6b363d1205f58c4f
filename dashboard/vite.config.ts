import { brotliCompressSync, constants } from 'node:zlib';
import { readFileSync, readdirSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { gzipSync } from 'fflate';
import { defineConfig, type Plugin } from 'vite';

const SERVER = process.env.PLAT_URL ?? 'http://127.0.0.1:8080';

export default defineConfig({
  base: './',
  oxc: { jsx: { runtime: 'automatic', importSource: 'preact' } },
  build: {
    target: 'es2022',
    assetsDir: 'assets',
    // Everything of the first page is small; only the viewer's chunk is large, and it is lazy.
    chunkSizeWarningLimit: 4000,
    reportCompressedSize: false,
    modulePreload: { polyfill: false },
  },
  server: { proxy: { '/api': SERVER, '/files': SERVER } },
  plugins: [sparkWasm(), licences(), precompress()],
});

/** Writes .br and .gz beside each text asset, so that the server compresses nothing at run time. */
function precompress(): Plugin {
  return {
    name: 'precompress',
    apply: 'build',
    closeBundle() {
      const dist = join(import.meta.dirname, this.environment.config.build.outDir);
      for (const entry of readdirSync(dist, { recursive: true, encoding: 'utf8' })) {
        if (!/\.(js|css|html|wasm)$/.test(entry)) continue;
        const path = join(dist, entry);
        const bytes = readFileSync(path);
        const params = { [constants.BROTLI_PARAM_QUALITY]: 11, [constants.BROTLI_PARAM_SIZE_HINT]: bytes.length };
        writeFileSync(`${path}.br`, brotliCompressSync(bytes, { params }));
        // fflate, not node's zlib: the bytes of zlib depend on how node and the CPU's extensions built it.
        writeFileSync(`${path}.gz`, gzipSync(bytes, { level: 9, mtime: 0 }));
      }
    },
  };
}

/** Spark carries its WebAssembly as base64, which compresses badly and is parsed with the script. As a file of its own it is smaller by a quarter, comes beside the splats, and is compiled while it comes. */
function sparkWasm(): Plugin {
  const inline = /const WASM = decode64\("([A-Za-z0-9+/=]+)"\)\.buffer;\s*const WASM_MODULE = WebAssembly\.compile\(WASM\);/;
  return {
    name: 'spark-wasm',
    apply: 'build',
    transform(code, id) {
      if (!id.endsWith('/@sparkjsdev/spark/dist/spark.module.js')) return null;
      const found = inline.exec(code);
      if (!found) throw new Error('Spark no longer carries its WebAssembly as it did: look at sparkWasm() in vite.config.ts');
      const file = this.emitFile({ type: 'asset', name: 'spark.wasm', source: Buffer.from(found[1]!, 'base64') });
      return { code: code.replace(inline, `const WASM_MODULE = WebAssembly.compileStreaming(fetch(import.meta.ROLLUP_FILE_URL_${file}));`), map: null };
    },
  };
}

/** The bundles contain other people's code; their licences must travel with it. */
function licences(): Plugin {
  const packages = ['@preact/signals', '@preact/signals-core', '@sparkjsdev/spark', 'fflate', 'preact', 'three', 'uplot'];
  return {
    name: 'licences',
    apply: 'build',
    generateBundle() {
      const texts = packages.map((name) => {
        const folder = join(import.meta.dirname, 'node_modules', name);
        const { version, license } = JSON.parse(readFileSync(join(folder, 'package.json'), 'utf8'));
        const file = readdirSync(folder).find((f) => /^licen[cs]e/i.test(f));
        const text = file ? readFileSync(join(folder, file), 'utf8').trim() : '';
        return `${name} ${version} (${license})\n\n${text}\n`;
      });
      this.emitFile({ type: 'asset', fileName: 'licences.txt', source: texts.join('\n----\n\n') });
    },
  };
}
