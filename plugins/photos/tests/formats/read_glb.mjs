// Print what three.js reads in the .glb file of the first argument.
import {readFileSync} from "fs";

globalThis.self = globalThis;
const {GLTFLoader} = await import("three/addons/loaders/GLTFLoader.js");
const {GLTFGaussianSplatLoaderExtension: Splats} =
  await import("three/addons/loaders/GLTFGaussianSplatLoaderExtension.js");
const loader = new GLTFLoader();
loader.register(parser => new Splats(parser));
const {scene, cameras, animations} =
  await loader.parseAsync(new Uint8Array(readFileSync(process.argv[2])).buffer, "");
scene.updateMatrixWorld(true);
const counts = [];
scene.traverse(({geometry}) => geometry && counts.push(geometry.instanceCount));
console.log(JSON.stringify({
  counts,
  cameras: cameras.map(({name, matrixWorld}) => ({name, world: matrixWorld.elements})),
  clips: animations.map(({name, duration, tracks}) => [name, duration, tracks.map(t => t.name)]),
}));
