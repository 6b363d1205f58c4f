// Views of the worst quality: the photo, the render, and where they differ.
import { useEffect, useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import type { View } from '../api';
import { ramp } from '../colours';
import { fixed } from '../format';
import { href } from '../route';
import { portrait } from '../viewer/portrait';

export function WorstViews({ job, views }: { job: number; views: View[] }) {
  const worst = [...views].filter((v) => v.psnr !== null).sort((a, b) => a.psnr! - b.psnr!).slice(0, 8);
  const chosen = useSignal<number | null>(null);
  if (worst.length === 0) return <div class="empty">No view of this block is held out and measured yet.</div>;
  const shown = worst.find((v) => v.view === chosen.value) ?? worst[0]!;
  return (
    <div class="body">
      <Triple key={shown.view} job={job} view={shown} />
      <div class="scroll">
        <table class="plain" style={{ marginTop: '8px' }}>
          <thead><tr><th>View</th><th class="n">PSNR, dB</th><th class="n">SSIM</th><th class="n">SSIMULACRA2</th><th>From</th><th /></tr></thead>
          <tbody>
            {worst.map((v) => (
              <tr key={v.view}>
                <td><button type="button" class="quiet" aria-pressed={v.view === shown.view} onClick={() => { chosen.value = v.view; }}>{v.name}</button></td>
                <td class="n num">{fixed(v.psnr, 2)}</td><td class="n num">{fixed(v.ssim, 3)}</td><td class="n num">{fixed(v.perceptual, 1)}</td>
                <td>{v.street === null ? '–' : v.street ? 'street' : 'air'}</td>
                <td><a href={href('view', { camera: v.view })}>In the viewer</a></td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </div>
  );
}

function Triple({ job, view }: { job: number; view: View }) {
  const error = useRef<HTMLCanvasElement>(null);
  const note = useSignal('');
  const photo = `/api/jobs/${job}/photos/${view.view}.jpg`;
  const made = useSignal('');
  const busy = useSignal(false);
  const render = made.value;
  useEffect(() => {
    if (!view.photo || !render) return undefined;
    let live = true;
    void Promise.all([picture(photo), picture(render)]).then(([a, b]) => {
      if (!live || !error.current) return;
      note.value = `mean error ${fixed(drawError(error.current, a, b), 1)} of 255`;
    }).catch((e: Error) => { note.value = e.message; });
    return () => { live = false; };
  }, [photo, render]);
  const draw = async (): Promise<void> => {
    busy.value = true;
    note.value = '';
    try { made.value = await portrait(job, view); } catch (e) { note.value = (e as Error).message; }
    busy.value = false;
  };
  return (
    <div class="triple">
      <figure>{view.photo ? <img src={photo} alt={`Photo ${view.name}`} /> : <div class="empty">The server has no photos.</div>}<figcaption>Photo · {view.name}</figcaption></figure>
      <figure>{render ? <img src={render} alt={`Render of ${view.name}`} /> : <div class="empty"><button type="button" disabled={busy.value} onClick={() => void draw()}>{busy.value ? 'Rendering …' : 'Render here'}</button></div>}<figcaption>Render{render ? ' by this browser, which differs a little from plat' : ''}</figcaption></figure>
      <figure>{view.photo && render ? <canvas ref={error} role="img" aria-label={`Error of ${view.name}: ${note.value}`} /> : <div class="empty">–</div>}<figcaption>Error · {note.value || 'dark is none, yellow is 64 of 255 and more'}</figcaption></figure>
    </div>
  );
}

async function picture(url: string): Promise<HTMLImageElement> {
  const image = new Image();
  image.src = url;
  try { await image.decode(); } catch { throw new Error(`${url} cannot be read`); }
  return image;
}

/** Draws the mean absolute difference of the channels; returns its mean over the picture. */
function drawError(canvas: HTMLCanvasElement, photo: HTMLImageElement, render: HTMLImageElement): number {
  const width = Math.min(640, render.naturalWidth);
  const height = Math.max(1, Math.round((width * render.naturalHeight) / render.naturalWidth));
  const [a, b] = [photo, render].map((image) => {
    const g = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true })!;
    g.drawImage(image, 0, 0, width, height);
    return g.getImageData(0, 0, width, height).data;
  }) as [Uint8ClampedArray, Uint8ClampedArray];
  const table = Array.from({ length: 256 }, (_, e) => ramp(e / 64).match(/\d+/g)!.map(Number));
  const out = new ImageData(width, height);
  let sum = 0;
  for (let i = 0; i < a.length; i += 4) {
    const e = Math.round((Math.abs(a[i]! - b[i]!) + Math.abs(a[i + 1]! - b[i + 1]!) + Math.abs(a[i + 2]! - b[i + 2]!)) / 3);
    sum += e;
    const [red, green, blue] = table[e]!;
    out.data[i] = red!; out.data[i + 1] = green!; out.data[i + 2] = blue!; out.data[i + 3] = 255;
  }
  canvas.width = width;
  canvas.height = height;
  canvas.getContext('2d')!.putImageData(out, 0, 0);
  return sum / (a.length / 4);
}
