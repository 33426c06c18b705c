"""Drop-ins for the packages people use today: one import to change.

| instead of | import |
|---|---|
| `waymo_open_dataset.wdl_limited.sim_agents_metrics.metrics` | `gump.compat.waymo` |
| CAT-K's `src.smart.metrics.wosac_metrics` | `gump.compat.catk` |
| TrajTok's `fast_sim_agents_metrics.metrics`, `fast_wosac_metric` | `gump.compat.trajtok` |
| PufferDrive's `pufferlib.ocean.benchmark.evaluator` | `gump.compat.pufferdrive` |
| nuplan-devkit's `MetricsEngine`; its planners in `gump.nuplan.simulate` | `gump.compat.nuplan` |

None of them needs TensorFlow, PyTorch or protobuf; where those are loaded, messages and tensors of
theirs are taken and given back.
"""
