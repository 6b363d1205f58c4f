// A view drawn by this browser, where the server has no render of it: the viewer's scene on a canvas beside the page, at the photo's size.
import { get, type ModelView, type View } from '../api';
import type { Stats } from './stage';

/** A software GPU takes seconds a frame beyond this width. */
const WIDEST = 960;
const PATIENCE_MILLIS = 60000;

/** The picture as a data URL, once the blocks that it shows have come. */
export async function portrait(job: number, view: View): Promise<string> {
  const [{ Stage }, model] = await Promise.all([import('./stage'), get<ModelView>(`/api/jobs/${job}/model`)]);
  const scale = Math.min(1, WIDEST / view.width);
  const [width, height] = [Math.round(view.width * scale), Math.round(view.height * scale)];
  const canvas = document.createElement('canvas');
  Object.assign(canvas.style, { position: 'fixed', left: '-9999px', top: '0', width: `${width}px`, height: `${height}px` });
  document.body.append(canvas);
  // Whole files, not pages of them: the picture must be complete, and nobody waits for its first half.
  const format = model.formats && !model.formats.includes('spz') ? null : 'spz';
  const stage = new Stage(canvas, job, model, { budget: 2e6, tint: false, outlines: false, seams: false, ghosts: false }, format);
  try {
    stage.capture(view);
    await settled(stage);
    return stage.picture(width, height);
  } finally {
    stage.close();
    canvas.remove();
  }
}

/** Until nothing is loading and four reports in a row say the same. */
function settled(stage: { onStats: (s: Stats) => void }): Promise<void> {
  return new Promise((done, failed) => {
    const timer = setTimeout(() => failed(new Error('the blocks did not come within a minute')), PATIENCE_MILLIS);
    let [last, same] = [-1, 0];
    stage.onStats = (s) => {
      same = s.pending === 0 && s.shown > 0 && s.shown === last ? same + 1 : 0;
      last = s.shown;
      if (s.errors[0]) failed(new Error(s.errors[0]));
      if (same < 4) return;
      clearTimeout(timer);
      done();
    };
  });
}
