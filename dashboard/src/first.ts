// The start of the model, asked for before the viewer's code is here: the line then carries both at once, and nobody waits for the other.
import type { defines } from '@sparkjsdev/spark';
import type { ModelBlock, ModelView } from './api';

/** What is known of a RAD file before its splats: Spark's own type. */
export interface Opened { meta: defines.RadMeta; chunksStart: number }

/** Less than any whole chunk has, so that nothing comes in vain; the rest of the first chunk is asked for once the header says how much that is. */
const START_BYTES = 1 << 19;
const asked = new Map<string, Promise<Opened | null>>();

export function blockUrl(job: number, block: ModelBlock): string {
  return `/api/jobs/${job}/blocks/${block.artefact}`;
}

/** Asks for the header and the first chunk of the coarsest finished block, which the viewer draws first. */
export function askFirst(job: number, model: ModelView): void {
  if (!model.formats?.includes('rad')) return;
  const level = (b: ModelBlock): number => Number(b.block.split('/')[0]);
  const coarsest = model.blocks.filter((b) => b.artefact !== null).sort((a, b) => level(a) - level(b))[0];
  if (!coarsest) return;
  const url = `${blockUrl(job, coarsest)}.rad`;
  if (!asked.has(url)) asked.set(url, open(url).catch(() => null));
}

/** What was asked for of this file, once; null where nothing was or it failed, and then Spark asks itself. */
export function takeFirst(url: string): Promise<Opened | null> | null {
  const opened = asked.get(url) ?? null;
  asked.delete(url);
  return opened;
}

async function open(url: string): Promise<Opened | null> {
  const [peeked, body] = (await range(url, 0, START_BYTES)).body!.tee();
  const whole = new Response(body).blob();
  const reader = peeked.getReader();
  const { value: head = new Uint8Array(8) } = await reader.read();
  void reader.cancel();
  const length = new DataView(head.buffer, head.byteOffset).getUint32(4, true);
  // The header is in the first packets, unless the file has thousands of chunks: then Spark asks for it itself.
  if (new TextDecoder().decode(head.subarray(0, 4)) !== 'RAD0' || 8 + length > head.length) return null;
  const meta = JSON.parse(new TextDecoder().decode(head.subarray(8, 8 + length))) as defines.RadMeta;
  const chunksStart = 8 + Math.ceil(length / 8) * 8;
  const first = meta.chunks[0]!;
  const [from, to] = [chunksStart + first.offset, chunksStart + first.offset + first.bytes];
  const rest = to > START_BYTES ? range(url, START_BYTES, to).then((reply) => reply.blob()) : null;
  const parts = [(await whole).slice(from, to)];
  if (rest) parts.push(await rest);
  // A chunk may be a file of its own, by URL: that is how Spark is given these bytes.
  first.filename = URL.createObjectURL(new Blob(parts));
  return { meta, chunksStart };
}

async function range(url: string, from: number, to: number): Promise<Response> {
  const reply = await fetch(url, { headers: { range: `bytes=${from}-${to - 1}` } });
  if (reply.status !== 206) throw new Error(`${url}: the server answered ${reply.status}`);
  return reply;
}
