"""Times training steps in PyTorch: forward, backward, clipping, AdamW, on one batch.

    python train_step.py FILE --precision f32|bf16 --threads N --steps N

FILE is what `cargo xtask bench train --torch` writes. Prints one line of JSON: `seconds` and
`cpu_seconds` of all steps after one to warm up, the first `loss` without dropout, the number of
`parameters`, and PyTorch's `version` and `capability`.
"""

import argparse
import json
import time

import torch

import network


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("file")
    parser.add_argument("--precision", choices=["f32", "bf16"], default="f32")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--steps", type=int, default=8)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    net, batch = network.load(arguments.file)
    parameters = {name: t.requires_grad_() for name, t in net.weights.items()}

    def decays(name, tensor):
        return tensor.dim() >= 2 and not name.endswith(("tables", "slots"))

    optimizer = torch.optim.AdamW(
        [
            {
                "params": [t for name, t in parameters.items() if decays(name, t) == decayed],
                "weight_decay": 1e-3 if decayed else 0.0,
            }
            for decayed in (True, False)
        ],
        lr=1e-5,
        fused=True,
    )
    autocast = torch.autocast(
        "cpu", dtype=torch.bfloat16, enabled=arguments.precision == "bf16"
    )

    dropout, net.dropout = net.dropout, 0.0
    with torch.no_grad(), autocast:
        loss = float(net.loss(batch))
    net.dropout = dropout

    def step():
        optimizer.zero_grad(set_to_none=True)
        with autocast:
            value = net.loss(batch)
        value.backward()
        torch.nn.utils.clip_grad_norm_(parameters.values(), 5.0)
        optimizer.step()

    step()
    began, cpu_began = time.perf_counter(), time.process_time()
    for _ in range(arguments.steps):
        step()
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
    print(
        json.dumps(
            {
                "seconds": seconds,
                "cpu_seconds": cpu_seconds,
                "loss": loss,
                "parameters": sum(t.numel() for t in parameters.values()),
                "version": torch.__version__,
                "capability": torch.backends.cpu.get_cpu_capability(),
            }
        )
    )


if __name__ == "__main__":
    main()
