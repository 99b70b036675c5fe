"""Train a custom network on stored clips in 30 lines: it predicts wrist positions from the object's pose.

python examples/train_on_batches.py data/embedded/grab
"""

import sys

import torch
from torch.utils.data import DataLoader

from hoidata.batches.dataset import HoiDataset, collate
from hoidata.store.annotated import load_annotated

torch.manual_seed(0)
dataset = HoiDataset(load_annotated(sys.argv[1]), "train", max_frames=60)
network = torch.nn.Sequential(torch.nn.Linear(10, 64), torch.nn.GELU(), torch.nn.Linear(64, 6))
adam = torch.optim.Adam(network.parameters(), 3e-3)
for epoch in range(5):
    dataset.set_epoch(epoch)
    losses = []
    for batch in DataLoader(dataset, batch_size=8, shuffle=True, collate_fn=collate):
        wrists = batch.joints_m[:, :, :, 0].transpose(1, 2)  # (clip, frame, side, 3) metres
        present = batch.present.transpose(1, 2)
        error = (network(batch.object).unflatten(-1, (2, 3)) - wrists).norm(dim=-1)[present]
        adam.zero_grad()
        error.mean().backward()
        adam.step()
        losses.append(error.mean().item())
    print(f"epoch {epoch}: {100 * sum(losses) / len(losses):.1f} cm")
