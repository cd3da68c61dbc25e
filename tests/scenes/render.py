"""Photographs of a scene by Mitsuba 3, and what is exactly known about their pixels.

Light is rendered in parts that add up (flash alone, ambient alone): radiance is linear in the emitters, and the flash then needs no coin toss
between them, so its direct part carries no noise but that of the sub-pixel position.
"""
import numpy as np
import mitsuba as mi

SUB = 8     # sub-pixel rays a side for masks, depth and albedo


def bsdf_of(material, reflectance):
    if material.alpha == 0:
        inner = {"type": "diffuse", "reflectance": reflectance}
    else:
        inner = {"type": "roughplastic", "distribution": "ggx", "alpha": material.alpha, "nonlinear": False, "diffuse_reflectance": reflectance}
    return {"type": "twosided", "b": inner}


def diffuse_albedo_factor(alpha):
    """Albedo over diffuse_reflectance of a roughplastic: pi times the body's reflectance function for light and view along the normal.

    The body's lobe is R/pi * T(in) T(out) / (eta^2 (1 - F_int)), with T the share that passes the rough interface and F_int the mean that the
    inside reflects back, each in one scattering. It is Lambert's but for T, which falls by 1 to 3 % up to 40 degrees and by 6 to 9 % up to 60
    (more where it is rougher). So this is the albedo that a diffuse model should find off the highlight with light and camera in front.
    The white-sky albedo, all light in and all light out, is lower.
    """
    if alpha == 0:
        return 1.0
    return float(np.pi * body_lobe(alpha, [0.0])[0])


def body_lobe(alpha, angles, reflectance=1.0):
    """Value of the diffuse lobe, 1/sr, for light along the normal and views at these angles (radians)."""
    bsdf = mi.load_dict({"type": "roughplastic", "distribution": "ggx", "alpha": alpha, "nonlinear": False, "diffuse_reflectance": {"type": "rgb", "value": [reflectance] * 3}})
    context = mi.BSDFContext()
    context.component = 1
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0, 0, 1)
    angles = np.asarray(angles, np.float32)
    wo = mi.Vector3f(mi.Float(np.sin(angles)), mi.Float(np.zeros_like(angles)), mi.Float(np.cos(angles)))
    return np.array(bsdf.eval(context, si, wo).x) / np.cos(angles)


def mitsuba_meshes(scene, mesh, colour):
    """One flat-shaded Mitsuba mesh per material, named object_MATERIAL. colour is the reflectance at the faces' corners, (F, 3, 3)."""
    which = material_of_faces(scene, mesh)
    return {"object_%d" % m: _mesh(mesh, which == m, colour, material) for m, material in enumerate(scene.materials) if (which == m).any()}


def material_of_faces(scene, mesh):
    centre = mesh.corners().mean(axis=1)
    return scene.material_of(centre) if scene.material_of else np.zeros(len(centre), int)


def corner_colours(scene, mesh, at_vertices):
    """(F, 3, 3): a colour per corner; of glossy faces one for the face, since Mitsuba's roughplastic takes no colours of vertices."""
    corners = at_vertices[mesh.faces].astype(np.float32)
    glossy = np.array([m.alpha > 0 for m in scene.materials])[material_of_faces(scene, mesh)]
    corners[glossy] = corners[glossy].mean(axis=1, keepdims=True)
    return corners


def _mesh(mesh, chosen, colour, material):
    faces, colour = mesh.faces[chosen], colour[chosen]
    if material.alpha == 0:
        # Vertices of one colour in all their faces are shared, as their colours come from the vertex.
        used, first, renamed = np.unique(faces, return_index=True, return_inverse=True)
        positions, indices = mesh.vertices[used], renamed.reshape(-1)
        texture = {"type": "mesh_attribute", "name": "vertex_color"}
    else:
        positions, indices = mesh.vertices[faces.reshape(-1)], np.arange(3 * len(faces))
        side = int(np.ceil(np.sqrt(len(faces))))
        texels = np.zeros((side * side, 3), np.float32)
        texels[:len(faces)] = colour[:, 0]
        texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels.reshape(side, side, 3)), "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
    properties = mi.Properties()
    properties["object_bsdf"] = mi.load_dict(bsdf_of(material, texture))
    shape = mi.Mesh("object", len(positions), len(faces), has_vertex_texcoords=material.alpha > 0, props=properties)
    if material.alpha == 0:
        shape.add_attribute("vertex_color", 3, colour.reshape(-1, 3)[first].astype(np.float32).ravel())
    p = mi.traverse(shape)
    p["vertex_positions"] = positions.astype(np.float32).ravel()
    p["faces"] = indices.astype(np.uint32)
    if material.alpha > 0:
        texel = np.arange(len(faces))
        uv = np.stack([(texel % side + 0.5) / side, (texel // side + 0.5) / side], 1)
        p["vertex_texcoords"] = np.repeat(uv, 3, axis=0).astype(np.float32).ravel()
    p.update()
    return shape


def sensor(scene, view, spp):
    r, t = view.camera_from_world()
    w, h = scene.size
    to_world = np.eye(4)
    to_world[:3, :3] = r.T
    to_world[:3, 3] = -r.T @ t
    return {"type": "perspective", "fov": float(np.degrees(2 * np.arctan(0.5 * w / scene.focal))), "fov_axis": "x", "near_clip": 0.01, "far_clip": 100.0,
            "principal_point_offset_x": 0.5 - scene.principal[0] / w, "principal_point_offset_y": 0.5 - scene.principal[1] / h,
            "to_world": mi.ScalarTransform4f(to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])),     # Mitsuba's camera: x left, y up, z forward
            "film": {"type": "hdrfilm", "width": w, "height": h, "pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": spp}}


def flash_emitter(position, intensity):
    return {"type": "point", "position": [float(v) for v in position], "intensity": {"type": "rgb", "value": [float(intensity)] * 3}}


def ambient_emitter(radiance):
    return {"type": "constant", "radiance": {"type": "rgb", "value": [float(radiance)] * 3}}


def radiance(shapes, emitter, camera, segments, seed, spp, roulette=5, launch=32):
    """Mean radiance (H, W, 3). Seeds differ per launch; a launch stays small enough for the memory of a small machine."""
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": segments, "rr_depth": roulette, "hide_emitters": True},
                          "sensor": camera, "emitter": emitter, **shapes}, optimize=False)
    total = 0.0
    rounds = max(1, int(np.ceil(spp / launch)))
    for n in range(rounds):
        total = total + np.array(mi.render(scene, spp=min(spp, launch), seed=seed * 1000 + n), np.float64)
    return total / rounds


def parts(scene, shapes, view, seed):
    """Radiance by origin: flash without bounces, flash with all of them, ambient with all of them, each (H, W, 3)."""
    flash = flash_emitter(view.flash_in_world(), scene.flash)
    camera = sensor(scene, view, scene.spp)
    direct = radiance(shapes, flash, camera, 2, seed * 10 + 1, min(scene.spp, 64))
    whole = radiance(shapes, flash, camera, scene.segments, seed * 10 + 2, scene.spp, scene.roulette)
    ambient = radiance(shapes, ambient_emitter(scene.ambient), camera, scene.segments, seed * 10 + 3, scene.spp, scene.roulette) if scene.ambient > 0 else 0 * direct
    return direct, whole, ambient


def subpixel_hits(scene, mesh, view):
    """Casts SUB x SUB rays a pixel by our own pinhole model: (face index or -1, weights (…, 3), distance), each (H, W, SUB^2)."""
    geometry = mi.load_dict({"type": "scene", "object": _plain(mesh)}, optimize=False)
    r, t = view.camera_from_world()
    w, h = scene.size
    steps = (np.arange(SUB) + 0.5) / SUB
    face = np.empty((h, w, SUB * SUB), np.int32)
    weights = np.empty((h, w, SUB * SUB, 3), np.float32)
    depth = np.empty((h, w, SUB * SUB), np.float32)
    for row in range(0, h, 64):
        rows = np.arange(row, min(row + 64, h))
        y, x, sy, sx = np.meshgrid(rows, np.arange(w), steps, steps, indexing="ij")
        d = np.stack([(x + sx - scene.principal[0]) / scene.focal, (y + sy - scene.principal[1]) / scene.focal, np.ones(x.shape)], -1).reshape(-1, 3)
        d = (d / np.linalg.norm(d, axis=1)[:, None]) @ r
        origin = np.broadcast_to(-r.T @ t, d.shape)
        found = geometry.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))), coherent=True)
        hit = np.array(found.is_valid())
        u, v = np.array(found.prim_uv.x), np.array(found.prim_uv.y)
        shape = (len(rows), w, SUB * SUB)
        face[rows] = np.where(hit, np.array(found.prim_index), -1).reshape(shape)
        weights[rows] = np.stack([1 - u - v, u, v], 1).reshape(shape + (3,))
        depth[rows] = np.where(hit, np.array(found.t), 0).reshape(shape)
    return face, weights, depth


def _plain(mesh):
    shape = mi.Mesh("object", len(mesh.vertices), len(mesh.faces))
    p = mi.traverse(shape)
    p["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
    p["faces"] = mesh.faces.astype(np.uint32).ravel()
    p.update()
    return shape


def pixel_truth(scene, mesh, albedo, view):
    """albedo: (F, 3, 3) at the faces' corners. Returns (covered fully (H, W) bool, mean albedo (H, W, 3), mean distance from the camera (H, W)); 0 where nothing is hit."""
    face, weights, depth = subpixel_hits(scene, mesh, view)
    hit = face >= 0
    number = np.maximum(hit.sum(axis=2), 1)
    mean = np.empty(hit.shape[:2] + (3,))
    for row in range(hit.shape[0]):     # by rows: the corners of all sub-pixels at once would be gigabytes
        at = albedo[np.maximum(face[row], 0)]
        value = np.einsum("xsk,xskc->xsc", weights[row], at) * hit[row][..., None]
        mean[row] = value.sum(axis=1) / number[row][:, None]
    return hit.all(axis=2), mean, (depth * hit).sum(axis=2) / number
