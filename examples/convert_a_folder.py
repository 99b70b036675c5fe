"""Convert a raw folder to a store: python examples/convert_a_folder.py grab /data/GRAB grab-store [MANO FOLDER]"""

import sys

from hoidata.conversion.convert import convert_dataset
from hoidata.datasets.registry import get_adapter
from hoidata.hands import load_embedded_hands, load_mano_hands
from hoidata.store.store import open_store

if __name__ == "__main__":  # workers import this file
    name, root, out, *mano = sys.argv[1:]
    hands = load_mano_hands(mano[0]) if mano else load_embedded_hands()
    print(convert_dataset(get_adapter(name), root, hands, out, jobs=2, synthetic=not mano, progress=False))
    store = open_store(out)
    print(store.sequences[["object", "verb", "n_frames"]].head())
