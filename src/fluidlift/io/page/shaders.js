// What the graphics card is told: how splats, the ground and solid bodies are placed and coloured.
const CAMERA = `
uniform vec3 eye; uniform mat3 turn; uniform vec4 lens; uniform vec2 size; uniform vec2 reach;
vec4 placed(vec2 uv, float z) {
  float d = (reach.y + reach.x) / (reach.y - reach.x) - 2.0 * reach.x * reach.y / ((reach.y - reach.x) * z);
  return vec4((2.0 * uv.x / size.x - 1.0) * z, (1.0 - 2.0 * uv.y / size.y) * z, d * z, z);
}`;
const SPLAT_VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D records; uniform vec3 low; uniform float grain; uniform vec2 scaled;
layout(location = 0) in uint index;
out vec2 at; flat out vec4 look;` + CAMERA + `
mat3 rotation(uvec3 q) {
  uint largest = (q.x >> 7) | ((q.y >> 7) << 1);
  vec3 kept = (vec3(q & 127u) / 63.5 - 1.0) * 0.70710678;
  float rest = sqrt(max(0.0, 1.0 - dot(kept, kept)));
  vec4 r = largest == 0u ? vec4(rest, kept) : largest == 1u ? vec4(kept.x, rest, kept.yz)
    : largest == 2u ? vec4(kept.xy, rest, kept.z) : vec4(kept, rest);
  r = normalize(r);
  float w = r.x, x = r.y, y = r.z, z = r.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); at = vec2(0.0); look = vec4(0.0);
  int width = textureSize(records, 0).x;
  uvec4 r = texelFetch(records, ivec2(int(index) % width, int(index) / width), 0);
  float opacity = float(r.w >> 24) / 255.0;
  vec3 p = low + grain * vec3(r.x & 65535u, r.x >> 16, r.y & 65535u);
  vec3 c = turn * (p - eye);
  if (c.z < reach.x || opacity < 1.0 / 255.0) return;
  vec3 s = exp(scaled.x + scaled.y * vec3((r.y >> 16) & 255u, r.y >> 24, r.z & 255u));
  s = min(s, vec3(0.25 * max(size.x, size.y) / max(lens.x, lens.y) * c.z));
  mat3 m = turn * rotation(uvec3((r.z >> 8) & 255u, (r.z >> 16) & 255u, r.z >> 24));
  m = mat3(m[0] * s.x, m[1] * s.y, m[2] * s.z);
  vec2 f = lens.xy / c.z, margin = 0.15 * size / lens.xy;
  vec2 t = clamp(c.xy / c.z, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  vec3 j0 = f.x * (vec3(m[0].x, m[1].x, m[2].x) - t.x * vec3(m[0].z, m[1].z, m[2].z));
  vec3 j1 = f.y * (vec3(m[0].y, m[1].y, m[2].y) - t.y * vec3(m[0].z, m[1].z, m[2].z));
  float a = dot(j0, j0) + 0.3, b = dot(j0, j1), d = dot(j1, j1) + 0.3;
  float middle = 0.5 * (a + d), spread = sqrt(max(0.25 * (a - d) * (a - d) + b * b, 0.0));
  float most = middle + spread, least = max(middle - spread, 1e-4);
  vec2 axis = abs(b) > 1e-6 ? normalize(vec2(most - d, b)) : (a >= d ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float far = min(sqrt(2.0 * log(opacity * 255.0)), 3.33);
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  at = far * corner;
  vec2 uv = lens.xy * c.xy / c.z + lens.zw + at.x * sqrt(most) * axis + at.y * sqrt(least) * vec2(-axis.y, axis.x);
  // a splat that lies on the ground is not cut by it
  float nearer = max(c.z - max(s.x, max(s.y, s.z)), reach.x * 1.01);
  gl_Position = placed(uv, nearer);
  look = vec4(vec3(r.w & 255u, (r.w >> 8) & 255u, (r.w >> 16) & 255u) / 255.0, opacity);
}`;
const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at; flat in vec4 look; out vec4 color;
void main() {
  float alpha = min(look.a * exp(-0.5 * dot(at, at)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  color = vec4(look.rgb * alpha, alpha);
}`;
const GROUND_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 point; layout(location = 1) in vec2 uv; layout(location = 2) in vec3 paint;
out vec2 where; out vec3 tint;` + CAMERA + `
void main() {
  vec3 c = turn * (point - eye);
  float d = (reach.y + reach.x) / (reach.y - reach.x) * c.z - 2.0 * reach.x * reach.y / (reach.y - reach.x);
  vec2 g = 2.0 * (lens.xy * c.xy + lens.zw * c.z) / size;
  gl_Position = vec4(g.x - c.z, c.z - g.y, d, c.z);
  where = uv; tint = paint;
}`;
const GROUND_FRAGMENT = `#version 300 es
precision highp float;
in vec2 where; in vec3 tint; uniform sampler2D picture; uniform bool textured; uniform float share; out vec4 color;
void main() { color = vec4(textured ? texture(picture, where).rgb : tint, 1.0) * share; }`;
const BODY_VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 point; layout(location = 1) in vec3 normal; layout(location = 2) in vec3 paint;
uniform vec3 origin, sun; uniform vec4 pose; out vec3 tint;` + CAMERA + `
vec3 posed(vec3 v) { return v + 2.0 * cross(pose.yzw, cross(pose.yzw, v) + pose.x * v); }
void main() {
  vec3 c = turn * (posed(point) + origin - eye);
  float d = (reach.y + reach.x) / (reach.y - reach.x) * c.z - 2.0 * reach.x * reach.y / (reach.y - reach.x);
  vec2 g = 2.0 * (lens.xy * c.xy + lens.zw * c.z) / size;
  gl_Position = vec4(g.x - c.z, c.z - g.y, d, c.z);
  tint = paint * (0.55 + 0.45 * max(dot(posed(normal), sun), 0.0));
}`;
const BODY_FRAGMENT = `#version 300 es
precision highp float;
in vec3 tint; out vec4 color;
void main() { color = vec4(tint, 1.0); }`;
