"""Times frames of a simulation in PyTorch: cached keys and values, then the decoder step by step.

    python frame.py FILE --agents N --futures N --frames N --history N --precision f32|bf16 --threads N
        --passes N

FILE is what `cargo xtask bench engine --torch` writes: weights and shapes. Tokens are random. A
frame has two tokens per agent and three more; every step takes in the last frame in its final form
and the next one in its provisional form, decodes the agents of the latter, and keeps the keys and
values of the former. With `--passes 1` or `2` nothing is kept: every step reads the whole history
again with the provisional frame, once as release 1.1 of the authors' model does, twice as release
1.0. The raster is encoded before. Prints one line of JSON, as train_step.py, with `operations`,
PyTorch's count of the floating-point operations of all frames.
"""

import argparse
import json
import time

import torch
import torch.nn.functional as F
from torch.utils.flop_counter import FlopCounterMode

import network


class Simulation:
    def __init__(self, net, agents, futures, history):
        self.net, self.agents, self.futures = net, agents, futures
        self.slots = 2 * agents + 3
        self.history = history
        c = net.model["width"]
        self.table = net.input_table()
        self.rows = net.output_rows()
        visual = net.place(torch.randn(1, net.positions.shape[0], c))
        self.visual = visual
        memories = net.memories(visual)
        self.memories = [[part.expand(futures, -1, -1, -1) for part in pair] for pair in memories]

    def tokens(self, n_frames):
        """Random tokens of some frames of every future, as the network reads them."""
        net, t = self.net, n_frames * self.slots
        n = self.futures * t
        table = net.weights["mct.tables"]
        keys = torch.arange(self.futures).unsqueeze(1) * t + torch.cat(
            [f * self.slots + 3 + 2 * torch.arange(self.agents) for f in range(n_frames)]
        )
        keys = keys.flatten()
        batch = {
            "rows": torch.randint(table.shape[0], (n, 12)),
            "sine_positions": keys + 1,
            "sines": torch.randn(len(keys), net.model["width"]),
            "local_map_rows": keys,
            "places": torch.randint(net.positions.shape[0], (3, len(keys))),
            "context_rows": keys,
        }
        if net.model["surroundings"]:
            n_numbers = net.weights["mct.surroundings.in.weight"].shape[1]
            batch["local_context"] = torch.randn(len(keys), n_numbers)
        return batch, t

    def read(self, batch, t, pasts):
        """The hidden vectors of all tokens, and their keys and values."""
        net = self.net
        net.shape.update(sequences=self.futures, tokens=t)
        x = net.embed(batch, self.visual)
        hidden, _, kept = net.layers(x, self.memories, pasts)
        return hidden, kept

    def frame(self, batch, t, pasts):
        """One frame; the keys and values of all tokens but those of the provisional frame."""
        hidden, kept = self.read(batch, t, pasts)
        hidden = hidden[:, -2 * self.agents :: 2].reshape(-1, hidden.shape[-1])
        self.decode(hidden)
        return [tuple(part[:, :, : -self.slots] for part in pair) for pair in kept]

    def decode(self, hidden):
        """Draws the states of all agents, a token at a time."""
        net = self.net
        n = net.model["gru_layers"]
        parts = ("input.weight", "hidden.weight", "input.bias", "hidden.bias")
        layers = [[net.weights[f"decoder.gru.{i}.{part}"] for part in parts] for i in range(n)]
        states = [hidden.float() for _ in layers]
        drawn = None
        for step, (begin, end) in enumerate(net.shape["step_rows"]):
            x = net.weights["decoder.slots"][step].expand_as(states[0])
            if drawn is not None:
                x = x + self.table[drawn]
            for i, weights in enumerate(layers):
                states[i] = torch.gru_cell(x, states[i], *weights)
                x = states[i]
            logits = F.linear(x, self.rows[begin:end])
            drawn = torch.multinomial(torch.softmax(logits.float(), dim=-1), 1).squeeze(1)
            drawn = drawn + begin + net.shape["field_row"]

    def run(self, frames, passes):
        """Some frames with a cache, or in so many passes without one."""
        pasts = None
        for i in range(frames):
            if passes:
                for _ in range(passes - 1):
                    self.read(*self.drawn[0], None)
                self.frame(*self.drawn[0], None)
                continue
            batch, t = self.drawn[0 if i == 0 else 1]
            pasts = self.frame(batch, t, pasts)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("file")
    parser.add_argument("--agents", type=int, default=32)
    parser.add_argument("--futures", type=int, default=1)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--history", type=int, default=3)
    parser.add_argument("--precision", choices=["f32", "bf16"], default="f32")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--passes", type=int, default=0, choices=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    net, _ = network.load(arguments.file)
    net.dropout = 0.0
    autocast = torch.autocast(
        "cpu", dtype=torch.bfloat16, enabled=arguments.precision == "bf16"
    )
    with torch.inference_mode(), autocast:
        simulation = Simulation(net, arguments.agents, arguments.futures, arguments.history)
        # The first step reads the history, later ones the last frame.
        simulation.drawn = [simulation.tokens(arguments.history + 1), simulation.tokens(2)]
        with FlopCounterMode(display=False) as counter:
            simulation.run(arguments.frames, arguments.passes)
        began, cpu_began = time.perf_counter(), time.process_time()
        simulation.run(arguments.frames, arguments.passes)
        seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu_began
    print(
        json.dumps(
            {
                "seconds": seconds,
                "cpu_seconds": cpu_seconds,
                "parameters": sum(t.numel() for t in net.weights.values()),
                "operations": counter.get_total_flops(),
                "version": torch.__version__,
                "capability": torch.backends.cpu.get_cpu_capability(),
            }
        )
    )


if __name__ == "__main__":
    main()
