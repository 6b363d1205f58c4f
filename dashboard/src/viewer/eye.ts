// The camera: orbit or fly, and standing exactly where a photo was taken.
import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import type { Camera, ModelView, View } from '../api';
import type { Eye } from './cut';

/** Where a photo lies in the picture, in CSS pixels. */
export interface Frame { left: number; top: number; width: number; height: number }

export class Mover {
  readonly camera = new THREE.PerspectiveCamera(55, 1, 0.1, 20000);
  readonly orbit: OrbitControls;
  mode: 'orbit' | 'fly' = 'orbit';
  /** Called when the reader moves the camera by hand. */
  onMove: () => void = () => {};
  private readonly keys = new Set<string>();
  private readonly stop = new AbortController();

  constructor(private readonly canvas: HTMLCanvasElement, private readonly model: ModelView) {
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, canvas);
    this.orbit.enableDamping = false;
    this.orbit.maxPolarAngle = Math.PI * 0.495;
    this.orbit.addEventListener('change', () => this.onMove());
    this.listen();
    this.overview();
  }

  close(): void {
    this.stop.abort();
    this.orbit.dispose();
  }

  setMode(mode: 'orbit' | 'fly'): void {
    this.mode = mode;
    this.orbit.enabled = mode === 'orbit';
    if (mode === 'orbit') {
      const ahead = this.camera.getWorldDirection(new THREE.Vector3());
      const height = Math.max(2, this.camera.position.z);
      this.orbit.target.copy(this.camera.position).addScaledVector(ahead, Math.min(this.model.root.edge / 4, height / Math.max(0.1, -ahead.z)));
    }
  }

  /** All of the scene, from the south at a slant. */
  overview(): void {
    const { root, centre } = this.model;
    this.look(root.x + root.edge / 2 - centre[0], root.y + root.edge / 2 - centre[1], root.edge);
  }

  look(x: number, y: number, edge: number): void {
    this.free();
    this.orbit.target.set(x, y, 0);
    this.camera.position.set(x, y - 0.75 * edge, 0.6 * edge);
    // The backdrop, sky and hills, lies far beyond the city.
    this.camera.far = Math.max(20000, this.model.root.edge * 40);
    this.camera.near = Math.max(0.05, edge / 5000);
    this.camera.updateProjectionMatrix();
    this.orbit.update();
    this.camera.lookAt(x, y, 0);
  }

  /** Stands at a capture camera; returns where its photo lies in the picture. */
  capture(view: View): Frame {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const c: Camera = view.camera;
    const scale = Math.min(w / view.width, h / view.height);
    const m = c.world_from_camera;
    const at = (i: number, j: number): number => m[4 * i + j]!;
    // OpenCV looks along +z with y down; three looks along -z with y up.
    const basis = new THREE.Matrix4().set(
      at(0, 0), -at(0, 1), -at(0, 2), at(0, 3) - this.model.centre[0],
      at(1, 0), -at(1, 1), -at(1, 2), at(1, 3) - this.model.centre[1],
      at(2, 0), -at(2, 1), -at(2, 2), at(2, 3) - this.model.centre[2],
      0, 0, 0, 1,
    );
    this.orbit.enabled = false;
    basis.decompose(this.camera.position, this.camera.quaternion, new THREE.Vector3());
    this.camera.near = 0.05;
    this.camera.fov = (2 * Math.atan(h / (2 * c.fy * scale)) * 180) / Math.PI;
    this.camera.aspect = w / h;
    // The principal point need not be in the middle.
    this.camera.setViewOffset(w, h, -(c.cx - view.width / 2) * scale, -(c.cy - view.height / 2) * scale, w, h);
    this.camera.updateProjectionMatrix();
    return { left: (w - view.width * scale) / 2, top: (h - view.height * scale) / 2, width: view.width * scale, height: view.height * scale };
  }

  /** Back from a capture camera to moving by hand. */
  free(): void {
    this.camera.clearViewOffset();
    this.camera.fov = 55;
    this.camera.updateProjectionMatrix();
    this.setMode(this.mode);
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / Math.max(1, height);
    this.camera.updateProjectionMatrix();
  }

  /** Moves by the keys held down; true if it moved. */
  step(seconds: number): boolean {
    if (this.mode !== 'fly' || this.keys.size === 0) return false;
    const speed = Math.max(4, Math.abs(this.camera.position.z)) * (this.keys.has('shift') ? 4 : 1) * seconds;
    const on = (key: string): number => (this.keys.has(key) ? 1 : 0);
    this.camera.translateZ((on('s') + on('arrowdown') - on('w') - on('arrowup')) * speed);
    this.camera.translateX((on('d') + on('arrowright') - on('a') - on('arrowleft')) * speed);
    this.camera.position.z += (on('e') - on('q')) * speed;
    this.onMove();
    return true;
  }

  eye(): Eye {
    const f = this.camera.getWorldDirection(new THREE.Vector3());
    const { x, y, z } = this.camera.position;
    const c = this.model.centre;
    return { at: [x + c[0], y + c[1], z + c[2]], forward: [f.x, f.y, f.z] };
  }

  private listen(): void {
    const options = { signal: this.stop.signal };
    this.canvas.addEventListener('keydown', (e) => { if (this.mode === 'fly' && !e.ctrlKey && !e.metaKey && e.key !== 'Tab') { this.keys.add(e.key.toLowerCase()); e.preventDefault(); } }, options);
    this.canvas.addEventListener('keyup', (e) => { this.keys.delete(e.key.toLowerCase()); }, options);
    this.canvas.addEventListener('blur', () => this.keys.clear(), options);
    this.canvas.addEventListener('pointermove', (e) => {
      if (this.mode !== 'fly' || e.buttons === 0) return;
      const turn = new THREE.Euler().setFromQuaternion(this.camera.quaternion, 'ZXY');
      turn.z -= e.movementX * 0.003;
      turn.x = Math.max(0.05, Math.min(Math.PI - 0.05, turn.x - e.movementY * 0.003));
      turn.y = 0;
      this.camera.quaternion.setFromEuler(turn);
      this.onMove();
    }, options);
  }
}
