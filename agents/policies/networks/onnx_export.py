"""Export of a trained policy's network as ONNX: ``duffing-env export POLICY --output network.onnx``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from agents.policies.networks.trained_policy import TrainedPolicy
from estimator.support.file_io import write_atomically
from estimator.support.optional_dependencies import require_packages

#: Version of the operators; old enough for current runtimes.
_OPSET_VERSION = 17


def export_network(policy: TrainedPolicy, path: str | Path) -> None:
    """Write the network of a policy as ONNX, in one piece.

    Its input ``observation`` (n, size) float32 is the observation, or the features of
    `agents.policies.networks.rollout_features`; features and shield are not part of the network. Its output ``action``
    (n, 1) is the choice in [-1, 1] of the deterministic policy.

    Args:
        policy: without a memory.
        path: of the file; its folder is made where it is missing.

    Raises:
        ModuleNotFoundError: without the package of the extra ``onnx``.
        ValueError: for a policy with a memory.
        OSError: where the file cannot be written.
    """
    require_packages("onnx")
    import onnx
    from onnx import helper, numpy_helper

    network = policy.network
    if network.memory is not None:
        raise ValueError(f"policy must have no memory, but has {network.memory}; export one that was trained by ppo")
    tensors: dict[str, Any] = {}
    nodes: list[Any] = []
    value = "observation"

    def add(operator: str, *given: str, **attributes: Any) -> None:
        nonlocal value
        made = f"{operator.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operator, [value, *given], [made], **attributes))
        value = made

    if policy.normalizer is not None:
        mean, std, clip = policy.normalizer
        tensors |= {"mean": mean, "std": std, "least": np.float32(-clip), "most": np.float32(clip)}
        add("Sub", "mean")
        add("Div", "std")
        add("Clip", "least", "most")
    for number, (weight, bias) in enumerate(policy.layers):
        if number:
            add({"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}[network.activation])
        tensors |= {f"weight_{number}": weight, f"bias_{number}": bias}
        add("Gemm", f"weight_{number}", f"bias_{number}", transB=1)
    if network.levels:
        tensors["levels"] = np.linspace(-1.0, 1.0, network.levels, dtype=np.float32)
        add("ArgMax", axis=1, keepdims=1)
        nodes.append(helper.make_node("Gather", ["levels", value], ["action"]))
    elif network.squashed:
        nodes.append(helper.make_node("Tanh", [value], ["action"]))
    else:
        tensors |= {"lowest": np.float32(-1), "highest": np.float32(1)}
        nodes.append(helper.make_node("Clip", [value, "lowest", "highest"], ["action"]))
    size = (policy.layers[0][0]).shape[1]
    float_type = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", float_type, ["n", size])],
        [helper.make_tensor_value_info("action", float_type, ["n", 1])],
        [numpy_helper.from_array(np.asarray(tensor, dtype=np.float32), name) for name, tensor in tensors.items()],
    )
    model = helper.make_model(
        graph, producer_name="duffing-env", opset_imports=[helper.make_opsetid("", _OPSET_VERSION)]
    )
    model.ir_version = 8  # of these operators
    onnx.checker.check_model(model)
    write_atomically(Path(path), model.SerializeToString())
