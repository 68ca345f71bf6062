# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows fused frames in the scene's compositor, as an Image node for each view layer."""

from collections.abc import Sequence

import bpy
from bpy.types import Node, NodeTree, Scene

from .render_settings import BLENDER_5, linear_override

NODE = "MSSPL Fused"
#: The custom property of a node that names its view layer.
_LAYER = "view_layer"


def show(scene: Scene, view_layer: str, path: str, connect: bool, frames: Sequence[int] | None = None) -> Node:
    """Load a fused EXR into the view layer's node ``MSSPL Fused``, which is made if there is none.

    A node that exists keeps its links. Render Layers nodes that nothing reads are muted, because Blender would render
    the scene again for them when it composites.

    Args:
        path: may begin with ``//``, which stands for the folder of the .blend.
        connect: connect the node to the compositor's output even if another node is connected there.
        frames: numbers of the frames of an animation, whose first file ``path`` is. None: it is a single frame.

    Returns:
        The node. Its outputs are the passes of the file.
    """
    tree, fresh = _tree(scene)
    ours = [node for node in tree.nodes if node.name.startswith(NODE)]
    node = next((node for node in ours if node.get(_LAYER, view_layer) == view_layer), None)
    if node is None:
        node = tree.nodes.new("CompositorNodeImage")
        node.name, node.label = NODE, f"{NODE} {view_layer}"
    node[_LAYER] = view_layer
    if node.image is None:
        node.image = bpy.data.images.load(path)
    else:
        node.image.filepath = path
    node.image.source = "SEQUENCE" if frames else "FILE"
    node.image.reload()
    node.image = node.image  # Blender then lists the passes of the new file.
    if frames:  # The file of frame n is shown at frame n.
        node.frame_duration, node.frame_start = frames[-1] - frames[0] + 1, frames[0]
        node.frame_offset, node.use_auto_refresh = frames[0] - 1, True
    space = linear_override(scene)
    if space:
        node.image.colorspace_settings.name = space
    else:  # The file holds scene-linear values, as the scene's own render does, so no colour conversion is wanted.
        node.image.colorspace_settings.is_data = True
    output = _output(tree)
    if connect or fresh or not output.inputs[0].is_linked:
        tree.links.new(node.outputs["Combined"], output.inputs[0])
    if tuple(node.location) == (0, 0):
        node.location = output.location.x - 400, output.location.y + 300 * len([node, *ours])
    for other in tree.nodes:
        if other.bl_idname == "CompositorNodeRLayers" and not any(socket.is_linked for socket in other.outputs):
            other.mute = True
    return node


def _tree(scene: Scene) -> tuple[NodeTree, bool]:
    """Return the compositor's node tree, and whether it was created now."""
    if BLENDER_5:
        fresh = scene.compositing_node_group is None
        if fresh:
            scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        return scene.compositing_node_group, fresh
    fresh = scene.node_tree is None  # Nodes that are turned off still belong to the user.
    scene.use_nodes = True
    return scene.node_tree, fresh


def _output(tree: NodeTree) -> Node:
    """Return the node that gets the composited image. Since Blender 5.0, it is the output of a node group."""
    kind = "NodeGroupOutput" if BLENDER_5 else "CompositorNodeComposite"
    if BLENDER_5 and not any(
        item.item_type == "SOCKET" and item.in_out == "OUTPUT" for item in tree.interface.items_tree
    ):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    outputs = [node for node in tree.nodes if node.bl_idname == kind]
    return next((node for node in outputs if getattr(node, "is_active_output", True)), None) or tree.nodes.new(kind)
