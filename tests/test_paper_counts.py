"""Counts in the papers and dataset releases, compared with the code; needs no data.

Numbers are from the papers (with section or table) and from the dataset publications. How many clips a
paper counts (Text2HOI: 660, 1,335 and 4,597) can only be checked on the licensed files.
"""

from collections import Counter

import numpy as np
import torch

from hoidata.batches.dataset import MAX_FRAMES
from hoidata.batches.requests import RequestBatch
from hoidata.clips import HandTrack
from hoidata.clips.features import HAND_FEATURES, OBJECT_FEATURES
from hoidata.contact.settings import ContactSettings
from hoidata.datasets.grab.adapter import OBJECTS
from hoidata.datasets.h2o.adapter import ACTIONS
from hoidata.hands import load_embedded_hands, track_joints
from hoidata.splits.definitions import definitions_for, published
from models.common.sampling import alphas_cumprod
from models.common.transformer import Encoder, TransformerConfig
from models.text2hoi.diffusion import Condition, DiffusionConfig, DiffusionModel

H2O_OBJECTS = {"book", "espresso", "lotion", "spray", "milk", "cocoa", "chips", "cappuccino"}
H2O_VERBS = ("grab", "place", "open", "close", "pour", "take out", "put in", "apply", "read", "spray", "squeeze")
ARCTIC_OBJECTS = {"box", "capsulemachine", "espressomachine", "ketchup", "laptop", "microwave", "mixer", "notebook",
                  "phone", "scissors", "waffleiron"}  # fmt: skip


class TestH2O:
    """The README and the action lists of taeinkwon/h2odataset."""

    def test_36_actions_of_11_verbs_on_8_objects_and_background(self):
        assert len(ACTIONS) == 36 + 1
        assert ACTIONS[0] == ("", "")
        assert len(set(ACTIONS)) == 37
        assert {noun for _, noun in ACTIONS[1:]} == H2O_OBJECTS
        assert list(dict.fromkeys(verb for verb, _ in ACTIONS[1:])) == list(H2O_VERBS)

    def test_184_sequences_with_eight_gaps_of_the_full_grid(self):
        grid = {
            f"subject{person}/{scene}/{take}"
            for person in (1, 2, 3, 4)
            for scene in ("h1", "h2", "k1", "k2", "o1", "o2")
            for take in range(8)
        }
        sequences = set(published("h2o").sequences)
        assert len(published("h2o").sequences) == len(sequences) == 184
        assert grid - sequences == {
            f"{folder}/7"
            for folder in ("subject1/k2", "subject2/h2", "subject2/k1", "subject2/k2", "subject2/o1", "subject2/o2",
                           "subject4/k1", "subject4/o2")
        }  # fmt: skip

    def test_933_segments_and_571645_images_of_five_cameras(self):
        """Kwon et al. 2021: 571,645 frames over five cameras."""
        listed = published("h2o")
        assert (len(listed.segments), len(listed.frames)) == (184, 184)
        assert sum(listed.segments) == 933
        assert sum(listed.frames) * 5 == 571_645


class TestGrab:
    """Taheri et al. 2020: 51 objects; Text2HOI, supplement 6: 29 action labels."""

    def test_51_objects_15_of_them_five_shapes_in_three_sizes(self):
        assert len(OBJECTS) == len(set(OBJECTS.values())) == 51
        sized = [words for words in OBJECTS.values() if words.split()[0] in ("small", "medium", "large")]
        assert Counter(words.split()[1] for words in sized) == dict.fromkeys(
            ("cube", "cylinder", "pyramid", "sphere", "torus"), 3
        )

    def test_the_official_split_leaves_41_objects_for_training(self):
        rule = definitions_for("grab")["official"].rule
        assert {*rule.test, *rule.validation} < set(OBJECTS)
        assert (len(rule.test), len(rule.validation), len(set(OBJECTS) - {*rule.test, *rule.validation})) == (6, 4, 41)

    def test_ten_subjects_are_shared_out_whole(self):
        for name in ("text2hoi", "unseen-subject"):
            rule = definitions_for("grab")[name].rule
            named = [*rule.names("train"), *rule.validation, *rule.test]
            assert sorted(named) == sorted(f"s{number}" for number in range(1, 11))


class TestArctic:
    """Fan et al. 2023 and the download lists of zc-alexfan/arctic."""

    def test_339_sequences_301_of_them_with_ground_truth(self):
        listed = published("arctic")
        assert len(listed.sequences) == len(set(listed.sequences)) == 339
        assert len(listed.usable) == 301
        assert Counter(name.split("/")[0] for name in listed.sequences) == {
            "s01": 34, "s02": 37, "s03": 38, "s04": 31, "s05": 34, "s06": 36, "s07": 29, "s08": 42, "s09": 37,
            "s10": 21,
        }  # fmt: skip

    def test_11_objects_in_73_grab_and_266_use_sequences(self):
        words = [name.split("/")[1].split("_") for name in published("arctic").sequences]
        assert {word[0] for word in words} == ARCTIC_OBJECTS
        assert Counter(word[1] for word in words) == {"grab": 73, "use": 266}

    def test_protocol_p1_has_267_34_and_38_sequences(self):
        subjects = Counter(name.split("/")[0] for name in published("arctic").sequences)
        rule = definitions_for("arctic")["p1"].rule
        parts = (rule.names("train"), rule.validation, rule.test)
        assert [sum(subjects[name] for name in part) for part in parts] == [267, 34, 38]


class TestBimArt:
    def test_44_test_and_257_training_sequences_of_11_objects(self):
        """BimArt, section 4: four test sequences of each object, one of them grasping and relocation only."""
        rule = definitions_for("arctic")["bimart"].rule
        assert (len(rule.names("train")), len(rule.validation), len(rule.test)) == (257, 0, 44)
        assert {*rule.names("train"), *rule.test} == set(published("arctic").usable)
        assert Counter(name.split("/")[1].split("_")[0] for name in rule.test) == dict.fromkeys(ARCTIC_OBJECTS, 4)
        assert sum("_grab_" in name for name in rule.test) == 11

    def test_as_released_44_of_301_test_of_which_13_are_grasps(self):
        rule = definitions_for("arctic")["bimart-released"].rule
        assert (rule.train, len(set(published("arctic").usable) - set(rule.test))) == ("rest", 257)
        assert Counter(name.split("/")[1].split("_")[0] for name in rule.test) == dict.fromkeys(ARCTIC_OBJECTS, 4)
        assert sum("_grab_" in name for name in rule.test) == 13


class TestText2Hoi:
    def test_a_hand_has_778_vertices_and_21_joints(self):
        """Supplement, Table S3: V = 778, J = 21."""
        hand = load_embedded_hands().right
        zeros = [np.zeros((1, columns)) for columns in (3, 3, 45, 10)]
        assert hand.template_m.shape == (778, 3)
        assert track_joints(HandTrack(*zeros, valid=np.ones(1, bool)), hand).shape == (1, 21, 3)

    def test_motion_is_99_numbers_per_hand_and_10_per_object_for_150_frames(self):
        """Sections 3.2 and 4.1: translation 3 + 16 x 6; translation 3 + 6 + articulation 1; L_max = 150."""
        assert (HAND_FEATURES, OBJECT_FEATURES, MAX_FRAMES) == (3 + 16 * 6, 3 + 6 + 1, 150)

    def test_contact_and_distances_end_at_2_centimetres(self):
        """Section 3.2.3 and the supplement, section 6: the threshold tau is 2 cm."""
        assert ContactSettings() == ContactSettings(points=1024, threshold_m=0.02)

    def test_noise_has_1000_steps(self):
        """Section 4.1: T = 1,000, cosine schedule (Nichol and Dhariwal 2021)."""
        cumulative_alpha = alphas_cumprod()
        assert cumulative_alpha.shape == (1000,)
        steps = (torch.arange(1000) + 1) / 1000
        cosine = torch.cos((steps + 0.008) / 1.008 * torch.pi / 2) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2
        np.testing.assert_allclose(cumulative_alpha[:900].numpy(), cosine[:900].numpy(), atol=2e-3)

    def test_the_transformer_has_8_layers_of_512_with_4_heads_and_1024_inside(self):
        """Supplement, Table S8."""
        config = TransformerConfig()
        assert (config.layers, config.width, config.heads, config.feed_forward) == (8, 512, 4, 1024)
        encoder = Encoder(config)
        sizes = {name: tuple(weight.shape) for name, weight in encoder.named_parameters() if weight.ndim == 2}
        assert sum(shape == (1024, 512) for shape in sizes.values()) == 8
        assert sum(shape == (512, 1024) for shape in sizes.values()) == 8

    def test_the_encoder_reads_451_tokens_for_150_frames(self):
        """Section 3.2: one condition, then three agents of 150 frames."""
        small = TransformerConfig(width=16, layers=1, heads=2, feed_forward=16)
        model = DiffusionModel(DiffusionConfig(transformer=small)).eval()
        shapes: list[tuple[int, ...]] = []
        model.encoder.register_forward_pre_hook(lambda _, inputs: shapes.append(tuple(inputs[0].shape)))
        batch = RequestBatch(
            objects=(),
            text=torch.ones(1, 512),
            points_m=torch.rand(1, 1024, 3),
            normals=torch.rand(1, 1024, 3),
            part=torch.zeros(1, 1024, dtype=torch.long),
            scale_m=torch.ones(1),
            active_hands=torch.ones(1, 2, dtype=torch.bool),
            frames=torch.ones(1, 150, dtype=torch.bool),
            lengths=torch.tensor([150]),
            counts=(150,),
            sides=(True, True),
            betas=torch.zeros(1, 2, 10),
            template_m=None,
            hinge_axis=torch.zeros(1, 3),
            hinge_origin_m=torch.zeros(1, 3),
            slide_m=torch.zeros(1, 3),
            articulated=torch.zeros(1, dtype=torch.bool),
        )
        condition = Condition(batch, batch.text, [None], torch.zeros(1, 2, 1024))
        with torch.no_grad():
            steps = torch.zeros(1, dtype=torch.long)
            hands, objects = model(torch.zeros(1, 2, 150, 99), torch.zeros(1, 150, 10), steps, condition)
        assert shapes == [(1, 451, 16)]
        assert (hands.shape, objects.shape) == ((1, 2, 150, 99), (1, 150, 10))
