"""The sequence network of gump in PyTorch, for timing: same tensors, same sums, same loss.

A file written by `cargo xtask bench train --torch` has the weights, a batch and the numbers that
their shapes depend on. Weights keep their names, so that a layer here is a prefix there.

Shapes: B sequences of T tokens, width C, S scenes, M visual tokens, K keys with a target.
"""

import json

import torch
import torch.nn.functional as F

STEPS = 16
MODES, FUTURE, PAST, POSE = 6, 16, 6, 4


def read(path):
    """The tensors of a safetensors file of f32, by name, and its metadata."""
    with open(path, "rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        data = bytearray(file.read())
    metadata = header.pop("__metadata__", {})
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        if begin == end:
            tensors[name] = torch.zeros(entry["shape"])
            continue
        flat = torch.frombuffer(data, dtype=torch.float32, count=(end - begin) // 4, offset=begin)
        tensors[name] = flat.reshape(entry["shape"]).clone()
    return tensors, metadata


def under(tensors, prefix):
    """The tensors whose names begin with `prefix`, which their new names lack."""
    return {name[len(prefix) :]: t for name, t in tensors.items() if name.startswith(prefix)}


class Network:
    """The network; `weights` are its parameters by name, `statistics` those of its batch norms."""

    def __init__(self, tensors, shape):
        self.weights = under(tensors, "weight.")
        self.statistics = under(tensors, "statistic.")
        constants = under(tensors, "constant.")
        self.positions = constants["positions"]
        self.sines = [constants[f"sines.{i}"] for i in range(7) if f"sines.{i}" in constants]
        self.shape = shape
        self.model = shape["model"]
        self.dropout = self.model["dropout"]

    # Layers, by the prefix of their weights.

    def linear(self, x, name):
        return F.linear(x, self.weights[name + ".weight"], self.weights.get(name + ".bias"))

    def norm(self, x, name):
        weight, bias = self.weights[name + ".weight"], self.weights[name + ".bias"]
        return F.layer_norm(x, weight.shape, weight, bias)

    def conv(self, x, name, stride, padding):
        weight, bias = self.weights[name + ".weight"], self.weights.get(name + ".bias")
        return F.conv2d(x, weight, bias, stride=stride, padding=padding)

    def batch_norm(self, x, name):
        weight, bias = self.weights[name + ".weight"], self.weights[name + ".bias"]
        mean, variance = (
            self.statistics[name + ".running_mean"],
            self.statistics[name + ".running_variance"],
        )
        return F.batch_norm(x, mean, variance, weight, bias, training=True, momentum=0.1)

    def drop(self, x):
        return F.dropout(x, self.dropout) if self.dropout > 0 else x

    def heads(self, x):
        b, t, c = x.shape
        n = self.model["heads"]
        return x.view(b, t, n, c // n).transpose(1, 2)

    # The map.

    def compact(self, x):
        p = "visual.backbone."
        x = F.gelu(self.conv(x, p + "patches", 4, 0))
        x = x + F.gelu(self.conv(x, p + "refine_patches", 1, 1))
        x = F.gelu(self.conv(x, p + "halve", 2, 1))
        return x + F.gelu(self.conv(x, p + "refine", 1, 1))

    def residual(self, x, p, stride):
        n = sum(f"{p}conv{i}.weight" in self.weights for i in range(3))
        y = x
        for i in range(n):
            kernel = self.weights[f"{p}conv{i}.weight"].shape[-1]
            # The 3 x 3 convolution with the stride: the first of two, the middle one of three.
            s = stride if i == n - 2 else 1
            y = self.batch_norm(self.conv(y, f"{p}conv{i}", s, kernel // 2), f"{p}norm{i}")
            if i + 1 < n:
                y = F.relu(y)
        if p + "shortcut_conv.weight" in self.weights:
            x = self.batch_norm(self.conv(x, p + "shortcut_conv", stride, 0), p + "shortcut_norm")
        return F.relu(x + y)

    def resnet(self, x):
        p = "visual.backbone."
        x = F.relu(self.batch_norm(self.conv(x, p + "stem_conv", 2, 3), p + "stem_norm"))
        x = F.max_pool2d(x, 3, 2, 1)
        for stage in range(4):
            i = 0
            while f"{p}stages.{stage}.{i}.conv0.weight" in self.weights:
                stride = 2 if i == 0 and stage > 0 else 1
                x = self.residual(x, f"{p}stages.{stage}.{i}.", stride)
                i += 1
        return x

    def features(self, raster):
        """Rasters [S, P, side, side] to visual features [S, M, C]."""
        if self.model["visual"]["encoder"] == "compact":
            x = self.conv(self.compact(raster), "visual.adaptor", 1, 0)
        else:
            x = self.conv(self.resnet(raster), "visual.adaptor", 1, 1)
            x = F.leaky_relu(self.batch_norm(x, "visual.adaptor_norm"), 0.01)
        return x.flatten(2).transpose(1, 2)

    def sine(self, x):
        x = F.relu(self.norm(self.linear(x, "mct.sine_in"), "mct.sine_norm"))
        return self.linear(x, "mct.sine_out")

    def place(self, features):
        return features + self.sine(self.positions)

    # The transformer.

    def embed(self, batch, visual):
        """Tokens to vectors [B, T, C]; `visual` [S, M, C] are features with their positions."""
        table = self.weights["mct.tables"]
        rows = batch["rows"]
        present = rows < table.shape[0]
        x = F.embedding_bag(
            torch.where(present, rows, 0),
            table,
            mode="sum",
            per_sample_weights=present.to(table.dtype),
        )
        if batch["sine_positions"].numel():
            sines = self.sine(batch["sines"])
            x = x.index_add(0, batch["sine_positions"], sines.to(x.dtype))
        if self.model["local_map"] and batch["local_map_rows"].numel():
            flat = visual.flatten(0, 1)
            places = enumerate(batch["places"])
            seen = sum(self.linear(flat[rows], f"mct.local.{i}") for i, rows in places)
            x = x.index_add(0, batch["local_map_rows"], seen.to(x.dtype))
        if self.model["surroundings"] and batch["context_rows"].numel():
            seen = F.gelu(self.linear(batch["local_context"], "mct.surroundings.in"))
            seen = self.linear(seen, "mct.surroundings.out")
            x = x.index_add(0, batch["context_rows"], seen.to(x.dtype))
        return self.drop(x.view(self.shape["sequences"], self.shape["tokens"], -1))

    def mlp(self, x, p):
        hidden = F.gelu(self.linear(self.norm(x, p + "norm_mlp"), p + "mlp_in"))
        return self.linear(hidden, p + "mlp_out")

    def block(self, x, p, past=None):
        """Self-attention and MLP. With `past`, a pair of keys and values [B, heads, T, d], the
        tokens of `x` follow those; returns the pair with them at its end."""
        qkv = self.linear(self.norm(x, p + "norm_attention"), p + "qkv")
        q, k, v = (self.heads(part) for part in qkv.chunk(3, dim=-1))
        if past is None:
            y = F.scaled_dot_product_attention(q, k, v, is_causal=True)
        else:
            k, v = torch.cat([past[0], k], dim=2), torch.cat([past[1], v], dim=2)
            mask = torch.ones(q.shape[2], k.shape[2], dtype=torch.bool)
            mask = mask.tril(k.shape[2] - q.shape[2])
            y = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        y = y.transpose(1, 2).reshape(x.shape)
        x = x + self.drop(self.linear(y, p + "attention_out"))
        return x + self.drop(self.mlp(x, p)), (k, v)

    def remember(self, visual, p):
        """Keys and values of the visual tokens for a layer of cross-attention."""
        return [self.heads(part) for part in self.linear(visual, p + "key_value").chunk(2, dim=-1)]

    def cross(self, x, memory, p):
        k, v = memory
        q = self.heads(self.linear(self.norm(x, p + "norm"), p + "query"))
        y = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(x.shape)
        x = x + torch.tanh(self.weights[p + "gate_attention"]) * self.linear(y, p + "out")
        y = self.mlp(x, p)
        gate = self.weights.get(p + "gate_mlp")
        return x + (y if gate is None else torch.tanh(gate) * y)

    def layers(self, x, memories, pasts=None):
        """All blocks; the hidden vectors, what trajectory heads read, and keys and values."""
        levels, kept = [], []
        for i in range(self.model["layers"]):
            x, kv = self.block(x, f"mct.blocks.{i}.", pasts[i] if pasts else None)
            kept.append(kv)
            if i % 3 == 0:
                x = self.cross(x, memories[i // 3], f"mct.cross.{i}.")
            if i in self.model["trajectory_heads"]:
                levels.append(x)
        return self.norm(x, "mct.norm"), levels, kept

    def memories(self, visual):
        n = self.model["layers"]
        return [self.remember(visual, f"mct.cross.{i}.") for i in range(0, n, 3)]

    # The state decoder.

    def input_table(self):
        own = self.weights.get("decoder.table")
        table = self.weights["mct.tables"][: self.shape["token_rows"]] if own is None else own
        if not self.sines:
            return table
        maps = [self.linear(s, f"decoder.smooth.input.{i}") for i, s in enumerate(self.sines)]
        maps = torch.cat(maps)
        before = self.shape["field_row"]
        return table + F.pad(maps, (0, 0, before, table.shape[0] - before - maps.shape[0]))

    def output_rows(self):
        first = self.shape["field_row"]
        n = max(end for _, end in self.shape["step_rows"])
        rows = self.weights["decoder.head.weight"][first : first + n]
        if not self.sines:
            return rows
        maps = [self.linear(s, f"decoder.smooth.output.{i}") for i, s in enumerate(self.sines)]
        return rows + torch.cat(maps)

    def gru(self, inputs, hidden):
        """Inputs [STEPS, K, C] through all layers, each beginning with `hidden` [K, C]."""
        n = self.model["gru_layers"]
        parts = ("input.weight", "hidden.weight", "input.bias", "hidden.bias")
        flat = [self.weights[f"decoder.gru.{i}.{part}"] for i in range(n) for part in parts]
        begin = hidden.unsqueeze(0).expand(n, -1, -1).contiguous()
        # Weights with biases, no dropout between layers, in training, one direction, steps first.
        return torch.gru(inputs, begin, flat, True, n, 0.0, True, False, False)

    def decode(self, hidden, tokens):
        """Outputs [STEPS, K, C] with the true tokens as inputs."""
        # Without a table of its own the decoder reads the transformer's.
        previous = F.embedding(tokens[:-1], self.input_table())
        inputs = F.pad(previous, (0, 0, 0, 0, 1, 0)) + self.weights["decoder.slots"].unsqueeze(1)
        return self.gru(inputs, hidden)[0]

    # The loss.

    def state_loss(self, flat, batch):
        outputs = self.decode(flat[batch["state.rows"]], batch["state.tokens"])
        rows = self.output_rows()
        weights = batch["state.weights"]
        total = 0.0
        # Steps of one field share its rows, so they share a product.
        for begin, end in sorted({tuple(pair) for pair in self.shape["step_rows"]}):
            steps = [i for i, pair in enumerate(self.shape["step_rows"]) if pair == [begin, end]]
            logits = F.linear(outputs[steps], rows[begin:end]).flatten(0, 1)
            losses = F.cross_entropy(
                logits.float(), batch["state.bins"][steps].flatten(), reduction="none"
            )
            total = total + (losses * weights[steps].flatten()).sum()
        return total / weights.sum()

    def spoken_loss(self, flat, batch):
        head = self.weights["decoder.head.weight"]
        begin, light = self.shape["begin"], self.shape["first_light"]
        control = torch.cat([head[: self.shape["control_keys"]], head[begin : begin + 3]])
        lights = head[light : light + self.shape["light_states"]]
        first = self.shape["token_rows"]
        classes = self.weights["mct.tables"][first : first + self.shape["classes"]]
        config = self.shape["loss"]
        total = 0.0
        for name, rows in (("control", control), ("lights", lights), ("classes", classes)):
            targets = batch[name + ".targets"]
            if targets.numel():
                logits = F.linear(flat[batch[name + ".rows"]], rows)
                total = total + config[name] * F.cross_entropy(logits.float(), targets)
        return total

    def trajectory_loss(self, levels, batch):
        if "trajectory.rows" not in batch or not levels:
            return 0.0
        rows = batch["trajectory.rows"]
        config = self.shape["loss"]
        total = 0.0
        for head, (level, weight) in enumerate(zip(levels, config["trajectory"][-len(levels) :])):
            flat = level.flatten(0, 1)
            x = torch.cat([flat[rows], flat[rows + 1]], dim=1)
            p = f"trajectory.{head}."
            for i in range(2):
                x = F.relu(self.norm(self.linear(x, f"{p}trunk{i}"), f"{p}norm{i}"))
            a = x.shape[0]
            past = self.linear(x, p + "past").view(a, PAST, POSE).float()
            future = self.linear(x, p + "future").view(a, MODES, FUTURE, POSE).float()
            modes = self.linear(x, p + "modes").float()
            off = future - batch["trajectory.future"].unsqueeze(1)
            distance = (off[..., :2].square().sum(-1) + 1e-5).sqrt()
            turn = off[..., 2:].abs().sum(-1)
            share = batch["trajectory.future_shares"].unsqueeze(1)
            error = ((distance + 2.0 * turn) * share).sum(-1)  # [A, MODES]
            best = error.detach().argmin(dim=1)
            regression = error.gather(1, best.unsqueeze(1)).sum()
            classification = F.cross_entropy(modes, best, reduction="sum")
            off = (past - batch["trajectory.past"]).abs()
            recall = off[..., :2].sum(-1) + 2.0 * off[..., 2:].sum(-1)
            recall = (recall * batch["trajectory.past_shares"]).sum()
            total = total + weight * (regression + classification + config["past"] * recall) / a
        return total

    def reconstruction_loss(self, features, raster):
        x = F.gelu(self.linear(features, "visual.reconstruction.hidden"))
        drawn = self.linear(x, "visual.reconstruction.pixels")
        s, planes, side, _ = raster.shape
        stride = 8 if self.model["visual"]["encoder"] == "compact" else 32
        n = side // stride
        patches = raster.view(s, planes, n, stride, n, stride).permute(0, 2, 4, 1, 3, 5)
        return F.l1_loss(drawn.float(), patches.reshape(s, n * n, -1))

    def loss(self, batch):
        """The loss of a training pass over the batch."""
        raster = batch["raster"]
        features = self.features(raster)
        visual = self.place(features)
        x = self.embed(batch, visual)
        hidden, levels, _ = self.layers(x, self.memories(visual))
        flat = hidden.flatten(0, 1)
        total = self.state_loss(flat, batch) + self.spoken_loss(flat, batch)
        total = total + self.trajectory_loss(levels, batch)
        if self.model["reconstruction"]:
            weight = self.shape["loss"]["reconstruction"]
            total = total + weight * self.reconstruction_loss(features, raster)
        return total


WHOLE = (
    "rows sine_positions local_map_rows places context_rows state.rows state.tokens state.bins control.rows "
    "control.targets lights.rows lights.targets classes.rows classes.targets trajectory.rows"
).split()


def load(path):
    """The network and the batch of a file."""
    tensors, metadata = read(path)
    network = Network(tensors, json.loads(metadata["shape"]))
    named = {}
    for name, tensor in tensors.items():
        if not name.startswith(("weight.", "statistic.", "constant.")):
            name = name.removeprefix("input.")
            named[name] = tensor.long() if name in WHOLE else tensor
    return network, named
