"""Warp kernel that casts one ray per pixel into a triangle mesh (forward only).

Pixel (i, j) looks along ((i - cx) / fx, (j - cy) / fy, 1) in camera axes; depth is the hit's z, not its range.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def texel(texels: wp.array[wp.vec3ub], first: int, width: int, height: int, x: int, y: int):
    """Colour of one texel, 0..255; outside of [0, 1] a texture repeats."""
    column = ((x % width) + width) % width
    row = ((y % height) + height) % height
    color = texels[first + row * width + column]
    return wp.vec3(float(color[0]), float(color[1]), float(color[2]))


@wp.func
def bilinear(texels: wp.array[wp.vec3ub], first: int, width: int, height: int, uv: wp.vec2):
    """Blend of the four texels around a texture coordinate."""
    x = uv[0] * float(width) - 0.5
    # Row 0 of the image is its top, v = 1.
    y = (1.0 - uv[1]) * float(height) - 0.5
    x0 = wp.floor(x)
    y0 = wp.floor(y)
    a = x - x0
    b = y - y0
    i = int(x0)
    j = int(y0)
    top = (1.0 - a) * texel(texels, first, width, height, i, j) + a * texel(texels, first, width, height, i + 1, j)
    low = (1.0 - a) * texel(texels, first, width, height, i, j + 1) + a * texel(
        texels, first, width, height, i + 1, j + 1
    )
    return (1.0 - b) * top + b * low


@wp.struct
class TexturedMesh:
    """A `wp.Mesh` and how its faces look."""

    mesh: wp.uint64
    faces: wp.array[wp.int32]  # (3 F,)
    colors: wp.array[wp.vec3]  # (V,) 0..255
    uvs: wp.array[wp.vec2]  # (V,)
    shade: wp.array[wp.float32]  # (F,)
    material: wp.array[wp.int32]  # (F,), -1 = vertex colours
    textures: wp.array[wp.vec3i]  # (M,): first texel, width, height
    texels: wp.array[wp.vec3ub]  # (T,)


@wp.kernel
def render_mesh(
    first: int,
    scene: TexturedMesh,
    focal: wp.vec2,
    center: wp.vec2,
    rotation: wp.mat33,  # camera to world
    origin: wp.vec3,
    max_depth: float,
    rgb: wp.array2d[wp.vec3ub],  # (H, W)
    depth: wp.array2d[wp.float32],  # (H, W) [m], 0 = miss
):
    """Cast the ray of one pixel, of the rows from ``first`` on, and write its colour and z-depth."""
    j, i = wp.tid()
    j += first
    ray = wp.vec3((float(i) - center[0]) / focal[0], (float(j) - center[1]) / focal[1], 1.0)
    length = wp.length(ray)
    query = wp.mesh_query_ray(scene.mesh, origin, rotation * (ray / length), max_depth * length)
    if not query.result:
        # A ray through a seam of differently subdivided triangles can slip between them: look 0.02 px beside it.
        ray = ray + wp.vec3(0.02 / focal[0], 0.013 / focal[1], 0.0)
        length = wp.length(ray)
        query = wp.mesh_query_ray(scene.mesh, origin, rotation * (ray / length), max_depth * length)
    if not query.result:
        rgb[j, i] = wp.vec3ub(wp.uint8(0), wp.uint8(0), wp.uint8(0))
        depth[j, i] = 0.0
        return
    depth[j, i] = query.t / length
    f = query.face
    a = scene.faces[3 * f]
    b = scene.faces[3 * f + 1]
    c = scene.faces[3 * f + 2]
    u = query.u
    v = query.v
    w = 1.0 - u - v
    color = u * scene.colors[a] + v * scene.colors[b] + w * scene.colors[c]
    if scene.material[f] >= 0:
        texture = scene.textures[scene.material[f]]
        color = bilinear(
            scene.texels, texture[0], texture[1], texture[2], u * scene.uvs[a] + v * scene.uvs[b] + w * scene.uvs[c]
        )
    color = color * scene.shade[f]
    rgb[j, i] = wp.vec3ub(
        wp.uint8(wp.clamp(color[0] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(color[1] + 0.5, 0.0, 255.0)),
        wp.uint8(wp.clamp(color[2] + 0.5, 0.0, 255.0)),
    )


@wp.struct
class DepthViews:
    """Depth images of one camera: pixel (u, v) is entry v * width + u of what ``image`` points to, float32 [m], 0 =
    missing; where that is 0, all pixels have the depth ``reach``.
    """

    rotation: wp.array[wp.mat33d]  # camera to world
    origin: wp.array[wp.vec3d]
    image: wp.array[wp.uint64]
    reach: wp.array[float]
    focal: wp.vec2d
    center: wp.vec2d
    width: int
    height: int


@wp.func_native("return ((const float*)views.image.data[view])[pixel];")
def depth_at(views: DepthViews, view: int, pixel: int) -> float:
    """Depth of a pixel [m]."""
    ...


@wp.func
def sees(views: DepthViews, view: int, point: wp.vec3d, tolerance: wp.float64) -> bool:
    """Whether a point lies in the image, and no more than ``tolerance`` behind the depth of its pixel."""
    p = wp.transpose(views.rotation[view]) * (point - views.origin[view])
    if not (p[2] > wp.float64(1.0e-6)):
        return False
    u = wp.rint(views.focal[0] * p[0] / p[2] + views.center[0])
    v = wp.rint(views.focal[1] * p[1] / p[2] + views.center[1])
    # Asked so that a NaN is not inside.
    inside = u >= wp.float64(0.0) and u < wp.float64(views.width) and v >= wp.float64(0.0)
    if not (inside and v < wp.float64(views.height)):
        return False
    depth = views.reach[view]
    if views.image[view] != wp.uint64(0):
        depth = depth_at(views, view, int(v) * views.width + int(u))
    return depth > 0.0 and p[2] <= wp.float64(depth) + tolerance


@wp.kernel
def mark_seen_points(
    first: int, points: wp.array[wp.vec3d], views: DepthViews, tolerance: wp.float64, seen: wp.array[wp.uint8]
):
    """Mark the points, from ``first`` on, that any of the views sees (CPU: images are pointers to its memory)."""
    tid = first + wp.tid()
    for view in range(views.image.shape[0]):
        if sees(views, view, points[tid], tolerance):
            seen[tid] = wp.uint8(1)
            return
