// What the pages share: the frames of cameras.json (a transforms.json; cameras look along -z with y up), and waiting.

export const { frames } = await (await fetch("cameras.json")).json();
export const [{ w: width, h: height }] = frames;

/** Whether opacity is compensated for what a splat is widened by on the screen: as the model was trained. */
export const isAntialiased = (await (await fetch("model.json")).json()).antialiased;

/** The vertical angle of view, radians. */
export const angle = (frame) => 2 * Math.atan(frame.h / (2 * frame.fl_y));

/** A column of a frame's camera-to-world matrix: 0 right, 1 up, 2 back, 3 place. */
export const axis = (frame, column) => frame.transform_matrix.slice(0, 3).map((row) => row[column]);

/** Renders until `state()`, which has what is loaded, has not changed for a while. */
export async function settle(render, state) {
    for (let round = 0, settled = 0, last; round < 400 && settled < 15; round++) {
        await render();
        await new Promise((done) => setTimeout(done, 100));
        const now = JSON.stringify(state());
        settled = now === last ? settled + 1 : 0;
        last = now;
    }
}

export const png = (canvas) => canvas.toDataURL("image/png").split(",")[1];
