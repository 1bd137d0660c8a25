"""GLSL of the film: one lean forward shader written for the lights at hand, the sky, and depth alone.

Display colours are squared to light and the sum goes back by a square root, a gamma of 2.0 that costs no
`pow`. The text is built per light, so that no pixel pays for kinds of lights that the film does not have.
"""

from collections.abc import Sequence

_INSTANCE = """#version 330 core
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;
layout(location = 3) in mat4 X_WG;
"""

DEPTH_VERTEX = (
    _INSTANCE
    + """
uniform mat4 view_projection;
void main() { gl_Position = view_projection * (X_WG * vec4(position, 1.0)); }
"""
)

DEPTH_FRAGMENT = """#version 330 core
void main() {}
"""

_SKY = """
uniform vec3 horizon;
uniform vec3 zenith;
uniform vec3 nadir;
vec3 sky(vec3 toward) {
    float rise = clamp(abs(toward.z) * 1.6, 0.0, 1.0);
    rise *= 2.0 - rise;
    return mix(horizon, toward.z > 0.0 ? zenith : nadir, rise);
}
"""

# The pattern averaged over the pixel's footprint: no moire at any distance (the box filters of I. Quilez).
_CHECKER = """
uniform vec3 checker0;
uniform vec3 checker1;
uniform vec3 checker2;  // of the lines along the edges of the image
uniform float edge;     // half their width, in images
vec3 checker(vec2 at) {
    vec2 width = max(abs(dFdx(at)), abs(dFdy(at))) + 1e-4;
    vec2 high = at + 0.5 * width, low = at - 0.5 * width;
    vec2 wave = (abs(fract(high) - 0.5) - abs(fract(low) - 0.5)) / width;
    vec2 line = floor(high + edge) + min(fract(high + edge) / (2.0 * edge), 1.0)
              - floor(low + edge) - min(fract(low + edge) / (2.0 * edge), 1.0);
    line = edge > 0.0 ? line * (2.0 * edge) / width : vec2(0.0);
    vec3 squares = mix(checker0, checker1, 0.5 - 0.5 * wave.x * wave.y);
    return mix(checker2, squares, (1.0 - line.x) * (1.0 - line.y));
}
"""

SKY_VERTEX = """#version 330 core
uniform mat4 rays;  // from clip space to directions in the world
out vec3 ray;
void main() {
    vec2 corner = vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID >> 1) * 4 - 1);
    gl_Position = vec4(corner, 1.0, 1.0);
    ray = (rays * vec4(corner, 1.0, 1.0)).xyz;
}
"""

SKY_FRAGMENT = (
    "#version 330 core\nin vec3 ray;\nout vec4 frag_color;\n"
    + _SKY
    + """
void main() {
    // Half a grey level of fixed noise keeps the slow gradient free of bands.
    float grain = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715)))) - 0.5;
    frag_color = vec4(sky(normalize(ray)) + grain / 255.0, 1.0);
}
"""
)


def forward_vertex(shadows: int) -> str:
    """Vertex shader that also places each vertex in `shadows` shadow maps."""
    declare = "".join(
        f"uniform mat4 shadow_matrix{i};\nuniform float texel{i};\nout vec4 in_map{i};\n"
        for i in range(shadows)
    )
    place = "".join(
        f"    in_map{i} = shadow_matrix{i} * vec4(p + (1.5 * texel{i}) * n, 1.0);\n" for i in range(shadows)
    )
    return (
        _INSTANCE
        + f"""
uniform mat4 view_projection;
uniform vec2 uv_scale;
uniform vec3 cube_scale;
out vec3 p;
out vec3 n;
out vec2 texture_uv;
out vec3 cube_direction;
{declare}
void main() {{
    p = (X_WG * vec4(position, 1.0)).xyz;
    n = mat3(X_WG) * normal;
    gl_Position = view_projection * vec4(p, 1.0);
    texture_uv = uv * uv_scale;
    cube_direction = position * cube_scale;
{place}}}
"""
    )


def forward_fragment(lights: Sequence[tuple[str, int]], *, texture: str, ground: bool) -> str:
    """Fragment shader for these lights, each (kind, index of its shadow map or -1).

    `texture`: "none", "checker", "2d" or "cube". `ground`: a plane, which fades into the sky with distance.
    """
    shadows = sum(index >= 0 for _, index in lights)
    declare = "".join(f"uniform sampler2DShadow shadow_map{i};\nin vec4 in_map{i};\n" for i in range(shadows))
    count = max(1, len(lights))
    sampler = {
        "none": "",
        "checker": "",
        "2d": "uniform sampler2D image;",
        "cube": "uniform samplerCube image;",
    }[texture]
    read = {
        "none": "",
        "checker": "    albedo *= checker(texture_uv);",
        "2d": "    vec4 ink = texture(image, texture_uv); albedo *= ink.rgb * ink.rgb; alpha *= ink.a;",
        "cube": "    vec3 ink = texture(image, cube_direction).rgb; albedo *= ink * ink;",
    }[texture]
    haze = "    shown = mix(shown, sky(-v), smoothstep(haze.x, haze.y, distance_to_eye));" if ground else ""
    body = "".join(_light(i, kind, shadow) for i, (kind, shadow) in enumerate(lights))
    return f"""#version 330 core
in vec3 p;
in vec3 n;
in vec2 texture_uv;
in vec3 cube_direction;
out vec4 frag_color;
uniform vec3 eye;
uniform vec4 base;      // linear RGB, alpha
uniform vec3 surface;   // specular, exponent, emission
uniform vec3 ambient_above;
uniform vec3 ambient_below;
uniform vec2 haze;
uniform vec3 light_position[{count}];
uniform vec3 light_direction[{count}];
uniform vec3 light_radiance[{count}];
uniform vec3 light_fade[{count}];
uniform vec2 light_cone[{count}];  // cosine of the cutoff, exponent
{sampler}
{declare}
{_SKY}
float lit(sampler2DShadow map, vec4 at) {{
    vec3 q = at.xyz / at.w;
    if (any(greaterThan(abs(q.xy - 0.5), vec2(0.5)))) return 1.0;
    vec2 step = 0.75 / vec2(textureSize(map, 0));
    q.z = min(q.z, 1.0);
    return 0.25 * (texture(map, vec3(q.xy + vec2(-step.x, -0.5 * step.y), q.z))
                 + texture(map, vec3(q.xy + vec2(0.5 * step.x, -step.y), q.z))
                 + texture(map, vec3(q.xy + vec2(step.x, 0.5 * step.y), q.z))
                 + texture(map, vec3(q.xy + vec2(-0.5 * step.x, step.y), q.z)));
}}
{_CHECKER if texture == "checker" else ""}
// x^e by Schlick's rational, which needs no pow.
float shine(float x, float e) {{ return x / (e - e * x + x); }}
void main() {{
    vec3 to_eye = eye - p;
    float distance_to_eye = length(to_eye);
    vec3 v = to_eye / distance_to_eye;
    vec3 m = normalize(gl_FrontFacing ? n : -n);
    vec3 albedo = base.rgb;
    float alpha = base.a;
{read}
    vec3 diffuse = mix(ambient_below, ambient_above, 0.5 + 0.5 * m.z);
    vec3 specular = vec3(0.0);
    float gloss = (surface.y + 8.0) * 0.015;
{body}
    // What a smooth coat mirrors of the surroundings, more of it at grazing angles, lifts dark parts.
    float graze = 1.0 - max(dot(m, v), 0.0);
    float mirrored = 0.02 + 0.2 * graze * graze * graze;
    vec3 around = mix(ambient_below, 3.0 * ambient_above, 0.5 + 0.5 * reflect(-v, m).z);
    vec3 light = albedo * (diffuse + surface.z) + surface.x * (0.3 * gloss * specular + mirrored * around);
    // A soft shoulder for what is brighter than white; by the brightest channel, so that hues stay.
    float peak = max(light.r, max(light.g, light.b));
    float above = max(peak - 0.8, 0.0);
    if (above > 0.0) light *= (0.8 + 0.2 * above / (above + 0.2)) / peak;
    vec3 shown = sqrt(light);
{haze}
    frag_color = vec4(shown, alpha);
}}
"""


def _light(i: int, kind: str, shadow: int) -> str:
    """GLSL that adds light `i` to `diffuse` and `specular`."""
    if kind == "directional":
        aim = f"        vec3 l = -light_direction[{i}];\n        float power = 1.0;\n"
    else:
        aim = f"""        vec3 to_light = light_position[{i}] - p;
        float d = length(to_light);
        vec3 l = to_light / d;
        float power = 1.0 / (light_fade[{i}].x + d * (light_fade[{i}].y + d * light_fade[{i}].z));
"""
    if kind == "spot":
        aim += f"""        float along = dot(-l, light_direction[{i}]);
        power *= smoothstep(light_cone[{i}].x, mix(light_cone[{i}].x, 1.0, 0.15), along)
               * pow(max(along, 1e-4), light_cone[{i}].y);
"""
    dim = f"            power *= lit(shadow_map{shadow}, in_map{shadow});\n" if shadow >= 0 else ""
    return f"""    {{
{aim}        float facing = dot(m, l);
        if (facing > 0.0 && power > 0.0) {{
{dim}            vec3 arriving = power * facing * light_radiance[{i}];
            diffuse += arriving;
            specular += arriving * shine(max(dot(m, normalize(l + v)), 0.0), surface.y);
        }}
    }}
"""
