"""What is supported, as data: the lists the scene analysis works from, and the README's support table.

`python -m psdr_jit.scene.capabilities` prints that table.
"""

from __future__ import annotations

from typing import NamedTuple

PLUGIN_NAMES = {
    # shapes
    "Mesh": "mesh", "OBJMesh": "obj", "PLYMesh": "ply", "SerializedMesh": "serialized",
    "BlenderMesh": "blender", "Cube": "cube", "Rectangle": "rectangle", "Disk": "disk",
    "Sphere": "sphere", "Cylinder": "cylinder", "Instance": "instance", "ShapeGroupPlugin": "shapegroup",
    "SDFGrid": "sdfgrid", "Ellipsoids": "ellipsoids", "EllipsoidsMesh": "ellipsoidsmesh",
    "BSplineCurve": "bsplinecurve", "LinearCurve": "linearcurve",
    # materials
    "SmoothDiffuse": "diffuse", "SmoothDielectric": "dielectric", "ThinDielectric": "thindielectric",
    "SmoothConductor": "conductor", "SmoothPlastic": "plastic", "PolarizedPlastic": "pplastic",
    "Null": "null", "RoughConductor": "roughconductor", "RoughDielectric": "roughdielectric",
    "RoughPlastic": "roughplastic", "Principled": "principled", "PrincipledThin": "principledthin",
    "Measured": "measured", "Hair": "hair", "MaskBSDF": "mask", "TwoSidedBRDF": "twosided",
    "BlendBSDF": "blendbsdf", "BumpMap": "bumpmap", "NormalMap": "normalmap",
    "DifferentiableDielectric": "psdr_dielectric", "DifferentiablePlastic": "psdr_plastic",
    # emitters
    "AreaLight": "area", "DirectionalArea": "directionalarea", "ConstantBackgroundEmitter": "constant",
    "EnvironmentMapEmitter": "envmap", "SunskyEmitter": "sunsky", "TimedSunskyEmitter": "timed_sunsky",
    "PointLight": "point", "SpotLight": "spot", "DirectionalEmitter": "directional",
    "Projector": "projector",
    # sensors
    "PerspectiveCamera": "perspective", "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic", "BatchSensor": "batch", "RadianceMeter": "radiancemeter",
    "IrradianceMeter": "irradiancemeter", "DistantSensor": "distant", "DistantSensorImpl": "distant",
    # textures
    "BitmapTexture": "bitmap", "BitmapTextureImpl": "bitmap", "Checkerboard": "checkerboard",
    "MeshAttribute": "mesh_attribute", "VolumeAdapter": "volume",
}  # fmt: skip
"""Class name -> the name used in scene files, which is the one a message should use."""

ANALYTIC_SHAPES = frozenset({"rectangle", "disk", "sphere", "cylinder"})

CURVE_SHAPES = frozenset({"bsplinecurve", "linearcurve"})
"""Tubes about splines and straight lines (`scene.surfaces`)."""

GRID_SHAPES = frozenset({"sdfgrid"})
"""Isosurfaces of values on a grid."""

ELLIPSOID_SHAPES = frozenset({"ellipsoids"})
"""Many ellipsoids as one shape."""

WITHOUT_MATERIAL = frozenset({"linearcurve", "sdfgrid", "ellipsoids"})
"""Shapes whose points have no coordinates that they keep while the shape moves."""

UNSUPPORTED_SHAPES = {
    "sdfgrid": "give its grid as many values along each axis, as Mitsuba mixes them up otherwise",
    "ellipsoids": "set extent_adaptive_clamping to false and do not instance them, or use meshes",
    "ellipsoidsmesh": "use meshes",
}
"""Shapes without an edge set: plugin -> the way out."""

INSTANCING = frozenset({"instance", "shapegroup"})
"""Shapes that show others. The edges of what they show are found; that these move is not modelled."""

COPIES = "load the mesh once per copy instead of instancing it"
"""The way out of what instances cannot do."""

SUPPORTED_SENSORS = frozenset({"perspective", "thinlens", "orthographic"})
"""Sensors whose film position of a scene point is known, so that edges can be projected."""

JUMPING_PLUGINS = frozenset({"checkerboard", "bumpmap"})
"""Discontinuous by construction; a bump map's normals step at texel centres even if its heights do not."""

PATTERN_PLUGINS = frozenset({"checkerboard", "bitmap", "bumpmap", "mesh_attribute"})
"""What has steps on surfaces that are edges of their own, if it has any."""

PATTERNS_ON_CURVES = frozenset({"checkerboard", "bitmap"})
"""The same, on B-spline and linear curves."""

FRAME_FREE_PLUGINS = frozenset({
    "diffuse", "dielectric", "thindielectric", "conductor", "plastic", "pplastic", "null", "roughconductor",
    "roughdielectric", "roughplastic", "principled", "principledthin", "mask", "twosided", "blendbsdf",
    "psdr_dielectric", "psdr_plastic",
})  # fmt: skip
"""Materials that do not see how the shading frame is turned about the normal, unless flagged as anisotropic."""

SMOOTH_PARAMETERS = frozenset({("plastic", "diffuse_reflectance"), ("psdr_plastic", "diffuse_reflectance")})
"""(plugin, parameter) of materials with a delta lobe: those that only shape the smooth lobe beside it."""

WEIGHED_PLUGINS = frozenset({
    "conductor", "dielectric", "thindielectric", "plastic", "psdr_dielectric", "psdr_plastic", "twosided",
})  # fmt: skip
"""Materials whose samples tell what their delta lobes are worth, attached to their parameters."""

TWINS = {("dielectric", "eta"): "psdr_dielectric", ("plastic", "eta"): "psdr_plastic"}
"""(plugin, parameter) that Mitsuba keeps as a plain number: our plugin that is the same otherwise."""

BENDING_PARAMETERS = frozenset({("psdr_dielectric", "eta")})
"""(plugin, parameter): those that turn the direction in which a delta lobe leads."""

UNIFORM_EMITTERS = frozenset({"area", "constant", "point", "spot", "directional"})
"""Lights that look the same from everywhere unless textured, or cannot be seen at all."""

POSE_PARAMETERS = frozenset({
    "to_world", "position", "direction", "sun_direction",
    "latitude", "longitude", "timezone", "year", "month", "day", "hour", "minute", "second",
})  # fmt: skip
"""Emitter parameters that move the light; all others scale or shape what it emits."""

CONE_PARAMETERS = frozenset({"cutoff_angle", "beam_width"})
"""Of a spot: they move the steps of its light, if it has any."""

SUN_SKIES = frozenset({"sunsky", "timed_sunsky"})
"""Skies with a sun, whose disc has a hard rim."""


class Row(NamedTuple):
    feature: str
    status: str  # "yes", "warning" or "error"
    note: str


_MOVING = "while geometry, a light's pose or the camera is differentiated; "

SUPPORT = (
    Row("meshes (obj, ply, serialized, cube, ...)", "yes", "welded; what UVs, normals and colours do at seams is seen"),
    Row("smooth-shaded meshes", "yes",
        "where normals turn away is an edge, and so is the plane of a face far off its normals, and of any "
        "that shines; glowing meshes of few faces that change in size: up to 1 % off; mirrors, two-sided bodies and, "
        "under point, spot and directional lights, any with normals far off their faces: warning"),
    Row("rectangle, disk, sphere, cylinder, B-spline and linear curve, SDF grid, ellipsoids", "yes",
        "stretched or sheared spheres and cylinders, mirrored ones that move, disks and instances turned about an axis "
        "that is not of length 1, SDF grids that are turned or have unequal numbers of values along the axes: error; "
        "smooth normals more than 10 degrees off the surface: warning"),
    Row("ellipsoidsmesh; instanced curves and ellipsoids", "error", _MOVING + "materials and radiance are fine"),
    Row("instances", "yes",
        "that rest; one that moves: error, load the mesh once per copy; tens of them: Mitsuba is slow with more"),
    Row("shape geometry, materials, textures", "yes", ""),
    Row("camera pose and intrinsics", "yes", ""),
    Row("perspective, thin lens, orthographic sensor", "yes", "a clipping plane that cuts what is seen: warning"),
    Row("batch sensor", "yes", "its sensors are rendered one by one, uncropped; `sample_border` needs equal filters"),
    Row("other sensors", "error", _MOVING + "materials and radiance are fine"),
    Row("area, constant, environment map", "yes",
        "warning: paint that shares texture coordinates; lights that `hide_emitters` hides before curved shapes, or "
        "where they stand on others or are spheres that cut into them; maps whose pose does more than to turn them"),
    Row("point, spot, directional light", "yes", "a rim that is hard but for a thousandth of the cone: warning"),
    Row("projector", "yes", "its frame, and checkerboards and nearest-neighbour bitmaps as its picture, are edges"),
    Row("sunsky", "warning",
        "while the camera or the sky turns: the rim of the sun disc is not sampled; poses that do more than turn it"),
    Row("rough and diffuse materials", "yes", ""),
    Row("mirrors, smooth glass and plastic, null, mask", "yes",
        _MOVING + "beside SDF grids that instances show: error; seen in them, frames of projectors and "
        "hard rims: warning; glass flush with a surface: warning; edges mirrored at the very rim of a ball: up to a "
        "third of their pixels is missing; masks before nothing: the image is that of `prb`, `path` drops light there"),
    Row("reflectance and IOR of mirrors, smooth glass and plastic", "yes",
        "IOR: `psdr_dielectric`, `psdr_plastic` in place of `dielectric`, `plastic`, which keep it as a plain number; "
        "behind glass as in the row above; opacity of a mask, what is under it or a bump map: error"),
    Row("hair; mirrors and glass under a mask, with bent normals, or blended with smooth materials", "error",
        "blends always, Mitsuba does not report their sampling density; others " + _MOVING.removesuffix("; ")),
    Row("checkerboard, nearest-neighbour bitmap, mesh attributes", "yes", "where texture coordinates move: warning"),
    Row("bump map, normal map", "yes",
        "a bump map's slopes step at edges, and so does what is sent where bent normals turn from the viewer (noisy "
        "where texels are small against pixels); these curves have no edge where a map is itself differentiated, or "
        "moves within another one, or on a curve, grid or ellipsoid: if half a per cent of what is seen of the shape "
        "is turned, or normals at a rim are bent by .01 from the viewer, warning; without `use_shadowing_function`: "
        "warning"),
    Row("participating media", "error", "ignored by Mitsuba's path as well"),
    Row("polarised variants", "error", ""),
    Row("films that convert samples themselves (specfilm)", "error", ""),
    Row("NaN vertices, empty meshes, meshes without area, scenes without shapes", "error", ""),
    Row("non-manifold edges, duplicate and collapsed faces", "yes", "many faces with three corners in a row: warning"),
    Row("meshes that cut into each other, a sphere or cylinder in a mesh", "yes",
        "the curve where they meet, also of parts of one mesh; smooth-shaded lights that touch others, lights in "
        "windows or masks: warning"),
    Row("disks, curves, SDF grids, ellipsoids that cut into others; spheres, cylinders into each other", "warning",
        "the pair is named; meshes do instead"),
    Row("scenes less than 0.1 units across", "warning", _MOVING + "Mitsuba's ray offsets are absolute lengths"),
    Row("scenes ten times as far from the origin as large", "warning", _MOVING + "rounding, in Mitsuba's path as well"),
)  # fmt: skip


def support_table() -> str:
    """`SUPPORT` as a Markdown table."""
    rows = [f"| {row.feature} | {row.status} | {row.note} |" for row in SUPPORT]
    return "\n".join(["| feature | status | note |", "|---|---|---|", *rows])


if __name__ == "__main__":
    print(support_table())
