import torch


def instances(centres, half, depths):
    order = depths.argsort(stable=True)
    pairs = []
    for tile in range(COLUMNS * ROWS):
        first = TILE * torch.tensor([tile % COLUMNS, tile // COLUMNS]) + 0.5
        last = first + TILE - 1
        touches = ((centres + half >= first) & (centres - half <= last)).all(dim=1)
        pairs += [(tile, row) for row in order.tolist() if touches[row]]
    tiles, rows = torch.tensor(pairs).T
    return tiles, rows


def draw(tiles, rows):
    image = torch.zeros(HEIGHT, WIDTH, 3)
    for tile in range(COLUMNS * ROWS):
        x, y = TILE * (tile % COLUMNS), TILE * (tile // COLUMNS)
        block = image[y : y + TILE, x : x + TILE]
        height, width = block.shape[:2]
        i, j = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
        pixels = torch.stack([i + x, j + y], dim=2).reshape(-1, 2) + 0.5
        block[:] = blend(pixels, rows[tiles == tile]).reshape(height, width, 3)
    return image
