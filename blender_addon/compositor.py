# SPDX-License-Identifier: GPL-3.0-or-later
"""The fused frame as an Image node in the scene's compositor."""

import bpy

from .render import V5

NODE = "MSSPL Fused"


def show(scene, path, connect):
    """Load a fused EXR into the node named ``MSSPL Fused``, which is made if it is not there; its links stay.

    Args:
        path: as a user writes it, ``//`` being the .blend's folder.
        connect: make it the compositor's output even if that comes from something else now.

    Returns:
        The node; its outputs are the file's passes.
    """
    tree, fresh = _tree(scene)
    node = tree.nodes.get(NODE)
    if node is None:
        node = tree.nodes.new("CompositorNodeImage")
        node.name = node.label = NODE
    if node.image is None:
        node.image = bpy.data.images.load(path)
    else:
        node.image.filepath = path
        node.image.reload()
        node.image = node.image  # its passes may be others now
    # Raw: the file holds what the scene's own render would hold at this place.
    node.image.colorspace_settings.is_data = True
    output = _output(tree)
    if connect or fresh or not output.inputs[0].is_linked:
        tree.links.new(node.outputs["Combined"], output.inputs[0])
    if tuple(node.location) == (0, 0):
        node.location = output.location.x - 400, output.location.y + 300
    return node


def _tree(scene):
    """The compositor's node tree, and whether there was none before."""
    if V5:
        fresh = scene.compositing_node_group is None
        if fresh:
            scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        return scene.compositing_node_group, fresh
    fresh = scene.node_tree is None  # nodes that are turned off are still the user's
    scene.use_nodes = True
    return scene.node_tree, fresh


def _output(tree):
    """The node whose first input becomes the picture: since Blender 5.0 the group's output."""
    kind = "NodeGroupOutput" if V5 else "CompositorNodeComposite"
    if V5 and not any(item.item_type == "SOCKET" and item.in_out == "OUTPUT" for item in tree.interface.items_tree):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    outputs = [node for node in tree.nodes if node.bl_idname == kind]
    return next((node for node in outputs if getattr(node, "is_active_output", True)), None) or tree.nodes.new(kind)
