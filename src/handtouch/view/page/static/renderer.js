// WebGL renderer of coloured triangle meshes with two directional lights.

const VERTEX = `#version 300 es
uniform mat4 model, view, projection;
uniform float nearer;
in vec3 corner, normal;
out vec3 facing, seen;
void main() {
  vec4 at = view * model * vec4(corner, 1.0);
  at.xyz -= nearer * normalize(at.xyz);
  facing = mat3(view) * mat3(model) * normal;
  seen = at.xyz;
  gl_Position = projection * at;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec4 colour;
uniform float lit;
in vec3 facing, seen;
out vec4 drawn;
void main() {
  vec3 n = normalize(facing), toViewer = normalize(-seen);
  if (!gl_FrontFacing) n = -n;
  vec3 key = normalize(vec3(-0.35, 0.75, 0.6)), fill = normalize(vec3(0.8, -0.1, 0.5));
  float shade = 0.34 + 0.62 * max(dot(n, key), 0.0) + 0.22 * max(dot(n, fill), 0.0);
  float gloss = 0.16 * pow(max(dot(n, normalize(key + toViewer)), 0.0), 28.0);
  drawn = vec4(mix(colour.rgb, colour.rgb * shade + gloss, lit), colour.a);
}`;

export class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: false });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "corner");
    gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = {};
    for (const name of ["model", "view", "projection", "colour", "lit", "nearer"]) this.at[name] = gl.getUniformLocation(program, name);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  // Uploads triangles; arrays of three numbers per corner.
  mesh(corners, normals) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (const [location, values] of [[0, corners], [1, normals]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 0, 0);
    }
    return { array, count: corners.length / 3 };
  }

  begin(view, projection, pixels) {
    const gl = this.gl, { canvas } = this;
    const wide = Math.max(1, Math.round(canvas.clientWidth * pixels)), high = Math.max(1, Math.round(canvas.clientHeight * pixels));
    if (canvas.width !== wide || canvas.height !== high) [canvas.width, canvas.height] = [wide, high];
    gl.viewport(0, 0, wide, high);
    gl.clearColor(0, 0, 0, 0);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.at.view, false, view);
    gl.uniformMatrix4fv(this.at.projection, false, projection);
  }

  // `lit` 1: shaded, 0: unshaded; `nearer`: shift towards the viewer in metres, against z-fighting;
  // `through`: drawn without depth test.
  draw(mesh, model, colour, { lit = 1, alpha = 1, nearer = 0, through = false } = {}) {
    const gl = this.gl;
    gl.bindVertexArray(mesh.array);
    gl.uniformMatrix4fv(this.at.model, false, model);
    gl.uniform4f(this.at.colour, ...colour, alpha);
    gl.uniform1f(this.at.lit, lit);
    gl.uniform1f(this.at.nearer, nearer);
    gl.depthMask(alpha === 1);
    if (through) gl.disable(gl.DEPTH_TEST);
    gl.drawArrays(gl.TRIANGLES, 0, mesh.count);
    if (through) gl.enable(gl.DEPTH_TEST);
  }
}

// Surface of revolution about z from a profile of [radius, height], seen from outside.
export function lathe(profile, sides = 20) {
  const corners = [], normals = [];
  for (let k = 0; k + 1 < profile.length; k++) {
    const [r0, z0] = profile[k], [r1, z1] = profile[k + 1];
    const size = Math.hypot(r1 - r0, z1 - z0) || 1, out = (z1 - z0) / size, up = (r0 - r1) / size;
    for (let side = 0; side < sides; side++) {
      const at = (r, z, angle) => [r * Math.cos(angle), r * Math.sin(angle), z];
      const a = (2 * Math.PI * side) / sides, b = (2 * Math.PI * (side + 1)) / sides;
      for (const [r, z, angle] of [[r0, z0, a], [r0, z0, b], [r1, z1, b], [r0, z0, a], [r1, z1, b], [r1, z1, a]]) {
        corners.push(...at(r, z, angle));
        normals.push(out * Math.cos(angle), out * Math.sin(angle), up);
      }
    }
  }
  return [new Float32Array(corners), new Float32Array(normals)];
}
