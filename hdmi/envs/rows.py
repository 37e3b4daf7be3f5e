"""Resets that cost what the environments that reset cost."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv


class RowResetEnv(TransformedEnv):
    """A `TransformedEnv` that resets only rows: the stack sees a batch of the n environments that are done.

    TorchRL computes a reset for all N environments and keeps n of them; where few episodes end at a step, a deep stack
    then costs twice. Here base environment and transforms are given the n rows, with their numbers
    under `worlds` int64 [n], and results are written into copies of the others' tensors. `reset` itself is unchanged.

    The base environment must have `reset_rows` (see `HumanoidObjectEnv`), and transforms must take the batch size
    from the tensordict.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self.any_done(tensordict):
            return tensordict
        worlds = tensordict.get("_reset").reshape(-1).nonzero().squeeze(-1)
        part = tensordict[worlds].set("worlds", worlds)
        tensordict = tensordict.exclude("_reset")
        part = self.transform._reset_env_preprocess(part)
        fresh = self.transform._reset(part, self.base_env.reset_rows(part))
        for key, value in fresh.items(True, True):
            # out of place: the collector keeps references to the last step's tensors
            tensordict.set(key, tensordict.get(key).index_copy(0, worlds, value))
        return tensordict
