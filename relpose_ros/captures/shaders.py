"""The programs that run on the graphics device (GLSL 3.30).

World coordinates are those of `relpose_ros.captures.scenes`, directions unit vectors.
"""

from __future__ import annotations

CONTACT_REACH = 1.7
"""Half width of the map of what darkens the ground beneath the object, object radii."""

SURFACE_VERTEX = """
#version 330
uniform mat4 clip_from_world;
uniform mat3 world_from_local;
in vec3 position;
in vec3 normal;
in vec2 uv;
in vec3 material;
out vec3 world;
out vec3 turned;
out vec3 texel;
out vec2 finish;
void main() {
    world = world_from_local * position;
    turned = world_from_local * normal;
    texel = vec3(uv, material.x);
    finish = material.yz;
    gl_Position = clip_from_world * vec4(world, 1.0);
}
"""

# Colours are squared on the way in and rooted on the way out: near enough to the sRGB curve.
# What a part does not need is compiled out: software OpenGL runs both sides of every branch.
SURFACE_FRAGMENT = """
#version 330
#define FEATURES
const float PI = 3.14159265;
uniform sampler2DArray surfaces;
uniform sampler2D mirrored;
uniform sampler2DShadow shadow_map;
uniform sampler2D contact;
uniform mat4 shadow_from_world;
uniform mat3 object_from_world;
uniform vec3 camera;
uniform vec3 to_light;
uniform vec3 key;
uniform vec3 ambient[9];
uniform float shadow;
uniform float ground_z;
uniform float sharpness;
in vec3 world;
in vec3 turned;
in vec3 texel;
in vec2 finish;
out vec4 colour;

vec3 light_onto(vec3 n) {
    return ambient[0] + ambient[1] * n.y + ambient[2] * n.z + ambient[3] * n.x
        + ambient[4] * (n.x * n.y) + ambient[5] * (n.y * n.z) + ambient[6] * (3.0 * n.z * n.z - 1.0)
        + ambient[7] * (n.x * n.z) + ambient[8] * (n.x * n.x - n.y * n.y);
}

vec3 light_from(vec3 direction, float level) {
    vec3 d = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
    vec2 folded = (1.0 - abs(d.yx)) * vec2(d.x < 0.0 ? -1.0 : 1.0, d.y < 0.0 ? -1.0 : 1.0);
    vec3 seen = textureLod(mirrored, (d.z < 0.0 ? folded : d.xy) * 0.5 + 0.5, level).rgb;
    return seen * seen;
}

void main() {
    vec3 base = texture(surfaces, texel, sharpness).rgb;
    vec3 n = normalize(turned);
    vec3 eye = normalize(camera - world);
    n = dot(n, eye) < 0.0 ? -n : n;
#ifdef RELIEF
    float height = (base.r + base.g + base.b) * 0.333 * finish.y;
    vec3 px = dFdx(world), py = dFdy(world);
    vec3 across = cross(py, n), down = cross(n, px);
    float area = dot(px, across);
    n = normalize((abs(area) + 1e-9) * n - sign(area) * (dFdx(height) * across + dFdy(height) * down));
#endif
    float lit = max(dot(n, to_light), 0.0);
#ifdef SHADOW
    lit *= 1.0 - shadow * (1.0 - texture(shadow_map, (shadow_from_world * vec4(world + n * 0.02, 1.0)).xyz));
#endif
    vec3 diffuse = light_onto(n);
    float above = max(world.z - ground_z, 0.0);
#ifdef OBJECT
    // What is near the ground and faces it sees less of the room.
    diffuse *= 1.0 - 0.45 * exp2(-7.0 * above) * (0.6 - 0.4 * n.z);
#else
    vec2 beneath = (object_from_world * world).xy / (2.0 * CONTACT_REACH) + 0.5;
    float dark = texture(contact, beneath).r * exp2(-8.0 * above);
    diffuse *= 1.0 - 0.85 * dark;
    lit *= 1.0 - 0.5 * dark;
#endif
    vec3 result = base * base * (key * lit + max(diffuse, 0.0));
#ifdef GLOSS
    float facing = max(dot(n, eye), 0.0), away = 1.0 - facing;
    float edge = 0.04 + 0.96 * away * away * away * away * away;
    float spot = exp2((dot(n, normalize(to_light + eye)) - 1.0) * 1.44 * exp2(3.0 + 6.0 * finish.x));
    result += key * lit * finish.x * spot * 0.8;
    result += finish.x * (0.08 + edge) * light_from(reflect(-eye, n), (1.0 - finish.x) * 4.0);
#endif
#ifdef OBJECT
    const float coverage = 1.0;
#else
    const float coverage = 0.0;
#endif
    colour = vec4(sqrt(result / (1.0 + 0.25 * dot(result, vec3(0.33)))), coverage);
}
""".replace("CONTACT_REACH", str(CONTACT_REACH))

BACKDROP_VERTEX = """
#version 330
uniform mat3 ray_from_pixel;
in vec2 corner;
out vec3 ray;
void main() {
    ray = ray_from_pixel * vec3(corner, 1.0);
    gl_Position = vec4(corner, 1.0, 1.0);
}
"""

BACKDROP_FRAGMENT = """
#version 330
const float PI = 3.14159265;
uniform sampler2D panorama;
uniform vec3 camera;
uniform vec3 room_half;
uniform vec3 eye;
uniform float level;
in vec3 ray;
out vec4 colour;
void main() {
    vec3 way = normalize(ray) + vec3(1e-6);
    vec3 walls = (sign(way) * room_half - camera) / way;
    vec3 hit = normalize(camera + min(walls.x, min(walls.y, walls.z)) * way - eye);
    vec2 place = vec2(atan(hit.y, hit.x) / (2.0 * PI) + 0.5, acos(clamp(hit.z, -1.0, 1.0)) / PI);
    colour = vec4(textureLod(panorama, place, level).rgb, 0.0);
}
"""

PLAIN_VERTEX = """
#version 330
uniform mat4 clip_from_local;
in vec3 position;
out vec3 local;
void main() {
    local = position;
    gl_Position = clip_from_local * vec4(position, 1.0);
}
"""

PLACE_FRAGMENT = """
#version 330
uniform float is_object;
in vec3 local;
out vec4 place;
void main() { place = vec4(local, is_object); }
"""

EMPTY_FRAGMENT = """
#version 330
void main() {}
"""
