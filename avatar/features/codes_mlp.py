"""3DMM Codes MLP: a conditional variational autoencoder on every vertex (paper, section 4.4, after SLRF, Zheng et al. 2022).

The condition is the codes and the vertex's place on the neutral head. In training an encoder turns the frame's place in time
and the condition into a small random latent, which may hold what the codes do not say; the decoder turns latent and condition
into the features. At test the latent is zero, the prior's mean.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.features import Condition, Features
from avatar.features.shared import POSITION_SIZE, VertexMLP, add_table, code_count, encoded_position, new_table
from avatar.networks import encoded_size, positional_encoding
from avatar.radiance import RadianceAvatar
from fitting.head_model import HeadModel

WIDTH, DEPTH = 256, 4  # of the decoder: 2.1 GFLOP a head of 4,570 vertices, where the U-Net takes 1.1 at 64 texels and 17 at 256
ENCODER_WIDTH, ENCODER_DEPTH = 128, 2  # it is thrown away after training, and only has to tell frames apart
LATENT = 16  # small: what it explains is missing at test
TIME_BANDS = 10  # 1,500 frames: the highest octave's period is 18 of them
LOG_VARIANCE_LIMIT = 8.0  # standard deviations between exp(-4) and exp(4), whatever the codes


class CodesMLPFeatures(nn.Module):
    """Vertex features from codes, place and, in training, time."""

    def __init__(self, head: HeadModel, channels: int, static: bool) -> None:
        """channels: values per vertex; static: add a learned constant to each vertex's features."""
        super().__init__()
        self.channels = channels
        codes = code_count(head)
        self.encoder = VertexMLP(
            (POSITION_SIZE, codes + encoded_size(1, TIME_BANDS), 0), ENCODER_WIDTH, ENCODER_DEPTH, 2 * LATENT
        )
        self.decoder = VertexMLP((POSITION_SIZE, codes, LATENT), WIDTH, DEPTH, channels)
        self.static = new_table(head, channels) if static else None
        # Times that noise was drawn. Part of the weights, so that a run continued from a checkpoint draws what it would have.
        self.register_buffer("draws", torch.zeros((), dtype=torch.int64))

    def posterior(self, condition: Condition, position: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of the latent, [B, V, LATENT] each, of heads whose time is known."""
        time = positional_encoding(condition.time[:, None], TIME_BANDS)
        mean, raw = self.encoder(position, torch.cat([condition.codes, time], -1), None).chunk(2, -1)
        return mean, LOG_VARIANCE_LIMIT * torch.tanh(raw / LOG_VARIANCE_LIMIT)

    def noise(self, like: Tensor) -> Tensor:
        """Standard normal numbers of the next draw, the same on every device."""
        generator = torch.Generator().manual_seed(int(self.draws))
        self.draws += 1
        return torch.randn(like.shape, generator=generator).to(like)

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels] and, where the time is known, the term `kl`.

        The latent is drawn in training mode, its mean otherwise, and zero without time.
        """
        position, latent, terms = encoded_position(condition.neutral_m), None, {}
        if condition.time is not None:
            latent, log_variance = self.posterior(condition, position)
            terms["kl"] = divergence(latent, log_variance)
            if self.training:
                latent = latent + torch.exp(log_variance / 2) * self.noise(latent)
        return Features(add_table(self.decoder(position, condition.codes, latent), self.static), terms)


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Kullback-Leibler divergence of the posterior from a standard normal in nats: sum over channels, mean over the rest."""
    return 0.5 * (mean.square() + torch.exp(log_variance) - 1 - log_variance).sum(-1).mean()


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    source = CodesMLPFeatures(head, settings["feature_channels"], settings["static_features"])
    return RadianceAvatar(source, settings, head)
