"""What a network is given: observation terms side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tensordict import NestedKey
from torchrl.data import Composite
from torchrl.envs import CatTensors


class Concatenate(CatTensors):
    """Concatenates what groups of the stack have written, in the order of groups and of the nodes in them.

    Reads the groups' entries [N, D_i], as they are by then; writes `out_key` [N, sum of D_i].

    Args:
        groups: entries of the stack that stand before.
        out_key: of the vector.
        written: entry of the stack -> keys that its transforms write.

    Attributes:
        widths: of the entries, once an environment has been asked for its specs.

    Raises:
        ValueError: for a group that does not stand before, or an entry that they write twice.

    Examples:
        >>> both = Concatenate(["body", "thing"], "policy", {"body": ["height"], "thing": ["mass"]})
        >>> data = TensorDict({"height": torch.tensor([[0.5]]), "mass": torch.tensor([[2.0]])}, batch_size=[1])
        >>> both(data)["policy"].tolist()
        [[0.5, 2.0]]
    """

    def __init__(self, groups: Sequence[str], out_key: NestedKey, written: Mapping[str, Sequence[NestedKey]]):
        if missing := [group for group in groups if group not in written]:
            raise ValueError(f"groups: {missing} do not stand before it in the stack; there is {list(written)}")
        keys = [key for group in groups for key in written[group]]
        if twice := sorted({str(key) for key in keys if keys.count(key) > 1}):
            raise ValueError(f"groups: {', '.join(twice)} written by more than one transform")
        super().__init__(in_keys=keys, out_key=out_key, dim=-1, del_keys=False, sort=False)
        self.widths: dict[NestedKey, int] = {}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = super().transform_observation_spec(observation_spec)
        self.widths = {key: observation_spec[key].shape[-1] for key in self.in_keys}
        return observation_spec
