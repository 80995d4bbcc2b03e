"""The sentence of every note code, one table a room; :mod:`palpate.report.notes` fills them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from palpate.core import few
from palpate.report.labels import number, percent, plural

#: What every reader of scores needs to know.
HOW_TO_READ = (
    "Arrows give the better direction: for TMMD, FID, KID, CMMD and LPIPS lower is better; for "
    "SSIM, PSNR and accuracies higher is; for I-, CI- and D-TMMD (→) closer to the floor is. "
    "The floor is what real images score (TMMD: train images of other videos of the materials; I-, "
    "CI- and D-TMMD: the test images): it, and not zero, is the target. "
    "I- and CI-TMMD far below it mean that the images vary less than real ones "
    "(collapse), not that they are better. "
    "The null band is where a meaningless difference would fall: a score inside it says nothing, "
    "and two scores whose intervals overlap widely are not distinguished."
)
#: Arguments whose option has another name.
_OPTIONS = {"side": "as", "columns": "map"}


@dataclass(frozen=True)
class Style:
    """How arguments are written in a sentence: as Python keywords or as options."""

    command_line: bool = False

    def __format__(self, spec: str) -> str:
        """``name`` or ``name=value`` in this style."""
        name, equals, value = spec.partition("=")
        if self.command_line:
            option = f"--{_OPTIONS.get(name, name).replace('_', '-')}"
            return option if value in ("", "True") else f"{option} {value}"
        written = value if value in ("True", "False", "None") else repr(value)
        return f"{name}={written}" if equals else name


Sentence = str | Callable[[Mapping[str, Any], Style], str]
#: Why a class, or a set, cannot be cut into halves (``details["excluded"]`` of scores).
EXCLUDED = {
    "few-samples": "too few samples",
    "one-group": "all samples are of one group",
    "single-samples": "no group has two samples",
    "no-label": "no label",
}
#: What a parameter of a note stands for.
WORDS: dict[str, dict[str, str]] = {
    "background": {
        "no contact": "their no-contact images",
        "other objects": "the median of images of other objects on the same gel and day",
        "own video": "the median of their own video",
        "whole set": "the median of the whole reference, which must be of one gel",
        "low-pass": (
            "their own low frequencies, by which faint contacts are lost (no background, too few "
            "images for a median): pass one no-contact image, or run palpate background"
        ),
    },
    "undefined": {
        **EXCLUDED,
        "few-samples": "fewer than {least} samples",
        "no-pairs": "an average over no pairs",
        "few-groups": "each set needs two groups, not all shared, for the grouped estimator",
        "one-sample": "each set needs two samples",
        "no-class": "no class can be cut into halves",
        "one-class": "needs two classes that can be cut into halves, has {classes}",
        "not-separate": "the classes do not separate (a denominator is not positive)",
        "score": "one of the two scores is",
        "no-images": "no pair of images has a value",
    },
    "no-interval": {
        "too-few": "too few groups or samples to leave one out",
        "different-units": "the two scores share no units to leave out",
        "no-units": "there is nothing to leave out",
        "no-change": "leaving out a unit is undefined, or changes nothing",
        "few-images": "one image or one group, or no variation between them",
    },
    "no-floor": {
        "classes": "other classes",
        "groups": "other groups",
        "group-sizes": "other numbers of samples a group",
        "sizes": "other numbers of samples",
    },
    #: Rule of a study -> what an excluded rater did.
    "rule": {
        "catches": "answered {value:percent} of the catch trials right, less than {limit:percent}",
        "finished": "answered {value:percent} of the trials, less than {limit:percent}",
        "side": "chose one side in more than {limit:percent} of the votes for a side",
    },
    "blank": {
        "tactile": "tactile images show untouched gel",
        "vision": "photos show nothing at all",
    },
}


def _excluded_classes(p: Mapping[str, Any], _: Style) -> str:
    names: dict[str, list[str]] = {}
    for name, why in p["excluded"].items():
        name = "samples" if why == "no-label" else name
        names.setdefault(EXCLUDED.get(why, str(why)), []).append(name)
    return "Excluded: " + "; ".join(f"{few(n)} ({why})" for why, n in names.items())


METRICS: dict[str, Sentence] = {
    "undefined": (
        "Undefined: {reason:undefined}{n!s: (n = {n})|}{labeled:| (the samples have no labels)}"
    ),
    "no-interval": "No interval: {reason:no-interval}",
    "no-floor": "No floor: real images of {reason:no-floor} have another value",
    "within-bound": (
        "Within {bound:.2g} of the exact value, as the bandwidth is narrow for moments"
    ),
    "independent-samples": (
        "The interval takes every sample as independent; frames of one video are not: where there "
        "are videos, give them as groups"
    ),
    "dependent-pairs": (
        "{count} ids are in both sets: a generated and a real image of one scene are not "
        "independent and pull this value below the truth; preset grouped excludes their pairs"
    ),
    "random-halves": (
        "Random halves carry no signal: the unbiased value averages 0 over halvings for any data; "
        "halves of whole videos do (preset grouped)"
    ),
    "collapse": "All features are equal: complete collapse, which this metric calls perfect",
    "unstable-denominators": (
        "Denominators {known_errors:within two standard errors of 0|of unknown error (too few "
        "groups)}, so the ratio is unreliable: {classes:few}"
    ),
    "repeated-ids": (
        "Rows with the id of another row (a DistributedSampler pads with repetitions): {count}; "
        "each counts"
    ),
    "copied-rows": (
        "{count} of {n} generated rows equal a real row bit for bit: a copy is not a generator"
    ),
    "identical-pairs": ("{count} of {n} pairs are identical (infinite), excluded from the mean"),
    "all-identical": "Undefined: all {n} pairs are identical, so the value is infinite",
    "no-pair-has-a-value": "Undefined: no pair has a value",
    "no-interval-over-images": (
        "No interval: one image or one group, or no variation between them"
    ),
    "no-interval-over-groups": "No interval: one group, or no variation between them",
    "no-interval-few-units": "No interval: too few groups or samples to leave some out",
    "fewer-scales": (
        "{scales} of the 5 scales (five need {least} pixels a side), weights divided by their sum: "
        "not comparable with MS-SSIM of 5"
    ),
    "no-contact": "{count} of {n} real images show no contact, excluded from the mean",
    "no-markers": "{count} of {n} images show too few markers of their gel, excluded from the mean",
    "empty-balls": "{count} of {n} {of} rows occur more than k times: their balls hold nothing",
    "fid-mostly-bias": (
        "Not meaningful: {n} samples do not span the {d} dimensions, so the value is mostly bias"
    ),
    "fid-biased": "Biased upwards, the more the fewer samples: compare at equal sizes only",
    "vendi-of-n": "Grows with the number of samples: compare at equal numbers only",
    "fid-difference-biased": "Of FID at this size, whose biases need not be equal",
}


def _equal_names(p: Mapping[str, Any], style: Style) -> str:
    equal = " and ".join(plural(n, f"equal {column}") for column, n in p["equal"].items())
    decided = "bytes and images decide" if p["images"] else "there are no images to compare"
    return (
        f"{p['roots'][0]} and {p['roots'][1]} have {equal}, which mean nothing by themselves: "
        f"{decided}. If both are one data set: {style:identity=names}"
    )


_THRESHOLD = "Threshold {threshold:.3f} from the best matches of {samples} train images "
_RATE = (
    "for {rate:.2%} of unrelated samples"
    "{few:; with so few the rate is an extrapolation, by a factor of three or more|}"
)
#: Column whose groups train and test share -> what the test part then asks for.
QUESTIONS = {
    "video": "new contacts of known videos",
    "object": "new videos of known objects",
    "session": "new videos of known sessions",
}


def question(shared: Mapping[str, Sequence[int]]) -> str:
    """Return what a test part asks for, e.g. ``new objects``; '' where neither is known.

    Args:
        shared: column -> (test groups that are in train, test groups).
    """
    shared_by = next((c for c in QUESTIONS if shared.get(c, (0, 0))[0]), "")
    new = next((f"new {c}s" for c in ("object", "session") if c in shared), "")
    return QUESTIONS.get(shared_by, new)


def _question(p: Mapping[str, Any], style: Style) -> str:
    shared, other = p["shared"], p["other"]
    line = f"This split is for {question(shared)}"
    if other == "video":
        line += f". For {QUESTIONS['object']}: {style:by=video}"
    elif other:
        count, total = shared[other]
        line += f": {count} of {total} test {other}s are in train. For new {other}s: "
        line += f"{style:{'by=' + other}}"
    return line


def _recordings(p: Mapping[str, Any], style: Style) -> str:
    levels: dict[str, list[str]] = {}
    for level, source in p["levels"]:
        levels.setdefault(source, []).append(f"{level}s")
    if not levels:
        return "Nothing says which samples are one recording"
    line = "; ".join(f"{', '.join(names)}: from {source}" for source, names in levels.items())
    guessed = any(source.startswith("file names") for source in levels)
    line += f" ({style:tactile=TEMPLATE} reads them another way)" * guessed
    return line[0].upper() + line[1:]


LEAKAGE: dict[str, Sentence] = {
    "backgrounds-unreadable": (
        "{count} background images cannot be read ({files:few}); their tactile images "
        "were compared as they are"
    ),
    "blank-images": (
        "{count} of {of} {modality:blank}{pairs: (by {pairs:pair} of backgrounds)|}, under "
        "{limit:.2f} gray levels, and were not compared"
    ),
    "cannot-tell-no-null": (
        "Cannot tell which similarity is chance: {threshold:train images of other videos are as "
        "similar as equal ones|none of the {images:train image} is known to be unrelated to enough "
        "others, by video or order}. The page and the table rank the pairs"
    ),
    "cannot-tell-untouched": "Nothing can be compared: no image of {part} shows any contact",
    "empty-files": "{count} files are empty (0 bytes) and were not compared",
    "equal-names": _equal_names,
    "group-few": (
        "There are fewer than {parts} {group}s: whole {taken}s are kept together instead, and "
        "train and test share a {group}"
    ),
    "group-instead": "The manifest knows no videos: the {group} is kept whole",
    "group-materials": lambda p, style: (
        f"Only {p['enough']} of {p['materials']} materials occur in {p['parts']} or more "
        f"{p['group']}s: no split can keep {p['group']}s whole with every material on both sides. "
        f"Whole {p.get('taken', 'contact')}s are kept together instead, so scores are optimistic "
        f"for new {p['group']}s. {style:{'by=' + p['group']}} keeps {p['group']}s whole, with "
        "fewer materials on both sides"
    ),
    "group-near-only": "The manifest knows no videos: near-duplicates alone are kept together",
    "group-of-data-set": "The data set says so: the {group} is kept whole",
    "images-absent": "{count} of {of} samples have no {modality} image and were not compared",
    "images-of-one-part": "Only one part has {modality} images: they were not compared",
    "images-unreadable": (
        "{count} {modality} images cannot be read and were not compared ({files:few})"
    ),
    "shared-videos": (
        "Whole contacts are kept together, but train and test share videos: what a shared video is "
        "worth is not in this number, and contacts of one video are less independent than the "
        "intervals take them to be"
    ),
    "impact-of-nothing": (
        "What leaking costs was not measured: without contact, or with images that are similar, "
        "a classifier recognizes recordings by the drift of the sensor, not materials"
    ),
    "impact-failed": lambda p, style: " ".join(
        [
            f"What leaking costs could not be measured: {p['reason']}",
            *(f"E.g. {style:{name}={value}}" for name, value in p.get("example", {}).items()),
        ]
    ),
    "missing-materials": "Could be in every part, but not together with the others: {materials}",
    "near-frames": (
        "{frames:Flagged up to {frames} frames; the score is 2^(-gap/{frames})|Flagged at a gap of "
        "0 frames only}"
    ),
    "no-group": (
        "Neither videos nor objects, sessions or contacts are known: only samples and images "
        "were compared"
    ),
    "no-materials": "No sample has a material: only the sizes of the parts are balanced",
    "numbers-next": (
        "The number of {count} of {of} test samples is beside one of train: if numbers are times, "
        "say so by a template whose only field is frame ({arg:tactile=TEMPLATE})"
    ),
    "not-noleak": (
        "This split is called {name!r}, not NoLeak: its own audit says {verdict}, and so do models "
        "that are trained on it"
    ),
    "photos-assumed": (
        "Nothing says what the images of {name} show, so they were taken for photos; if they are "
        "tactile images: {arg:side=tactile}{arg.command_line:| (in reading)}"
    ),
    "images-not-found": (
        "No image that the table names is a file below {root}, so images were not read; pass the "
        "folder that its paths start from as {arg:root=FOLDER}"
    ),
    "path-column": "The paths are those of the column {column}, most of whose cells name images",
    "question": _question,
    "rare-materials": "In fewer than {parts} groups, so not in every part: {materials}",
    "recordings": _recordings,
    "rows-skipped": "{count} bad rows were skipped ({problems:few})",
    "samples-in-no-part": "{count} of {of} samples of the manifest are in no part of the split",
    "signal-not-counted": "Reported, but not counted as a leak: the audit is not by {group}",
    "signal-nulls": "{count} {part} samples have no {group}: nothing is known of them",
    "split-shares": (
        "The split {name!r} is not NoLeak: {count} of {of} {group}s of its test part are in train, "
        "so a model that is trained on it has seen them"
    ),
    "split-of-other-manifest": "The split was made for another manifest (the digests differ)",
    "threshold-order": (
        f"{_THRESHOLD}far from them in the order of the files, as no videos are known "
        f"({{groups:piece}}), {_RATE}"
    ),
    "threshold-videos": f"{_THRESHOLD}in other videos ({{groups:group}}), {_RATE}",
    "validation-leaks": (
        "{count} {group} groups of the validation part occur in train or test as well: "
        "choosing a checkpoint on it leaks"
    ),
    "videos-without-samples": lambda p, _: (
        f"{len(p['videos'])} of the record's {p['of']} videos have no sample here, first "
        f"{p['videos'][0]}"
    ),
}


def _materials_excluded(params: Mapping[str, Any], _: Style) -> str:
    materials = "; ".join(f"{m} ({why})" for m, why in sorted(params["materials"].items()))
    return f"Excluded ({len(params['materials'])} of {params['total']} materials): {materials}"


def _verdict_of_two(p: Mapping[str, Any], _: Style) -> str:
    parts = [
        f"{p[name]} is better by {', '.join(p[f'by_{name}'])}" for name in "ab" if p[f"by_{name}"]
    ]
    parts += [f"not decided by {', '.join(p['open'])}"] * bool(p["open"])
    return "; ".join(parts)


EVALUATION: dict[str, Sentence] = {
    "few-test-groups": (
        "A test part holds {count} {group} group(s) only: the intervals are wide, and too trusting "
        "if anything"
    ),
    "materials-excluded": _materials_excluded,
    "probe-no-label": "The samples have no {label} in {part}: nothing was predicted from it",
    "probe-no-image": "{count} samples without a {modality} image are excluded",
    "probe-unlabeled": "{count} test samples without a {label} are excluded from its accuracy",
    "probe-one-class": "All train samples have the {label} {only!r}: there is nothing to classify",
    "probe-no-encoder": "These encoders include none of {modality}: no retrieval with it",
    "probe-no-partner": "The test samples have no {modality}: no retrieval with it",
    "probe-some-partners": (
        "{count} test samples without {modality} are excluded from retrieval with it"
    ),
    "no-material": "{count} samples without a material are excluded",
    "below-floor": (
        "{metric}, {subject}: below the floor of real images, so these vary less than real "
        "ones do; that is not better"
    ),
    "companion-skipped": "{name} skipped: {must}; got {got}",
    "pseudo-labels": (
        "The classes are {clusters} clusters of {of}, not materials: not comparable with scores "
        "over materials"
    ),
    "synthetic-encoder": (
        "The encoder was trained on simulated tactile images alone, and {real:these are real|"
        "nothing says whether these are real}: what it sees in real ones is unproven. Train an "
        "encoder on real images, or trust the contact scores"
    ),
    "seen-images": (
        "The {modality} encoder was trained on {seen:,} of the {n:,} images that it judges here"
    ),
    "seen-dataset": (
        "The {modality} encoder was trained on {dataset}: it may have seen the images that it "
        "judges here"
    ),
    "pretraining-sets": (
        "The {modality} encoder was trained on {sets}, without a list of the images: if these are "
        "of one of them, it may have seen them"
    ),
    "text-cut": (
        "The text has {tokens} tokens, of which its encoder reads {most}: the words at its end "
        "have no effect"
    ),
    "photos-unlike": (
        "Unlike {least:percent} of the training photos or more: {count} of {of:photo} "
        "({photos:few}). The generator never saw the like, and its images of them mean nothing"
    ),
    "words-unseen": "No text of the training has {words:few}: what they do to the image is chance",
    "text-unlike": "The text is unlike {rate:percent} of the texts of the training",
    "stored-otherwise": lambda p, style: (
        "The images are stored in other ways, which scores of texture see first: "
        + "; ".join(f"{name} {' and '.join(forms)}" for name, forms in p["forms"].items())
        + ". They are compared after the same lossy storage"
        + (f"; {style:as_is=True} leaves them" if p.get("kept") else "")
    ),
    "as-stored": "As the images are stored: {value:.4g}",
    "gel-contact": (
        "{gel} looks like a contact, or like no image of a gel: a smooth fit leaves {left:.1f} "
        "gray levels of its colors, and under 4 of a gel that nothing touches. The images are made "
        "on it all the same"
    ),
    "gel-sensor": (
        "{gel} is lit from other sides than the gels that the generator knows: a sensor of another "
        "kind, on which its contacts are implausible"
    ),
    "shear-without-markers": (
        "This gel has no markers, by which a generator shows a shear: it has no effect"
    ),
    "strength-unseen": (
        "{count:,} of {n:,} images were asked for a strength that touches of surfaces like theirs "
        "did not have in training: these lay in {low:.2f} to {high:.2f}"
    ),
    "encoder-license": lambda p, _: (
        f"The {p['modality']} encoder is {p['name']}, whose license is "
        + ("not stated: see its page" if p["license"] == "unknown" else p["license"])
    ),
    "encoder-of-other-split": (
        "The tactile encoder was trained on another split: it may have seen test samples"
    ),
    "background-kind": (
        "The ruler measures images minus {kind:background}; scores of another kind of background, "
        "or of another reference, share no column with these"
    ),
    "encoder-without-split": "The tactile encoder comes without a record of its split",
    "generator-of-other-split": (
        "The generator was not trained on this split: it may have seen test samples"
    ),
    "kid-interval": (
        "The spread over random subsets that others print with KID is no interval; this one is"
    ),
    "no-differences": "No differences between generators: they are not of the same samples",
    "groups": "Intervals and p are by {level}; {level}s: from {source}",
    "group-finer": (
        "Several {group}s are of one {level}: intervals and p are by {used}, and by {level} they "
        "are right"
    ),
    "groups-few": (
        "No intervals and no p: {count} {level}s a side are known, and {least} are the fewest that "
        "tell how much {level}s differ"
    ),
    "groups-unknown": (
        "No intervals and no p: nothing says which images are of one recording, and frames of one "
        "are nearly copies. Name files <video>_<frame>, give a table with id and video (of scores "
        "{arg:labels=videos.csv}), or say that no two belong together by {arg:group=frame}"
    ),
    "verdict-of-two": _verdict_of_two,
    "no-pairs": (
        "Scores of pairs of images skipped for {names}: the ids are not those of the reference"
    ),
    "outside-test-part": (
        "{name}: {skipped} of {n} samples lie outside the split's test part, and were skipped"
    ),
    "resized": (
        "Pixels are compared at {size} x {size}, the generators' size: the reference's {side} px "
        "were resized, and smaller images score higher"
    ),
    "row-pairs": "Row k of every generator is taken for the same sample: the rows have no ids",
    "too-many-rows": (
        "{name} skipped: it forms all pairs of more than {rows:,} rows; request it with "
        "{arg:companions}"
    ),
    "wide-sigma-alone": (
        "Sigma 10 alone: several bandwidths form all pairs of more than {rows:,} rows; request "
        "them with {arg:sigma=multi}"
    ),
}


CAPTIONS: dict[str, Sentence] = {
    "captions-alone": (
        "{count} of {of} samples have no {per}: each is described, and counted, by itself"
    ),
    "captions-code": (
        "Without any name of a material the text still names the material in {accuracy:.0%} of new "
        "videos: it is a code of the label, and scores that use it (CI- and D-TMMD, material "
        "accuracy) reward copying it"
    ),
    "captions-common": "{count} captions have one text: {text!r}",
    "captions-few": (
        "Whether the text gives the material away was not measured: that needs ten videos and two "
        "materials, got {groups} and {materials}"
    ),
    "captions-no-labels": "The samples have no materials: labels in the text were not looked for",
    "captions-none": "No caption can be used: {flags}",
    "captions-of-columns": (
        "Captions were filled from columns ({template}): they say no more than these do, and "
        "scores that use them measure the label"
    ),
    "captions-words": "Most often: {words}",
}


OTHER: dict[str, Sentence] = {
    "synthetic-data": (
        "The data are synthetic: palpate's procedural world. It shows mechanisms (leaks, guidance, "
        "what the metrics reward); never compare its numbers with those of real data"
    ),
    "models-shipped": (
        "The models that training goes on from are small, ship with palpate ({name}), and were "
        "trained on synthetic worlds of reserved seeds, none of them this data. They replace the "
        "pretrained models of the paper"
    ),
    "template-texts": (
        "This data set has no texts: training used template texts made from the material, so text "
        "carries no more than the label, and class-aware scores (CI- and D-TMMD, material "
        "accuracy) favor such a generator"
    ),
    "background-predicts-material": (
        "The no-contact image alone predicts the material of {share:.0%} of the test samples, far "
        "above chance: each video has its gel look, and the probe has learned that. Material "
        "accuracy under this split measures the video, not the contact"
    ),
    "text": "{text}",
    "excluded-classes": _excluded_classes,
    "nearer-to-floor": (
        "Which is nearer to the floor: confidence and p are of |a - floor| - |b - floor|"
    ),
    "no-contact-baseline": (
        "No contact: what the no-contact image scores in place of a contact score; squared errors "
        "(PSNR) prefer it to a wrong tactile image"
    ),
    "no-floor-of-tmmd": (
        "No floor: that of TMMD is of train videos of a split, others than those of the test part, "
        "of each of its materials"
    ),
    "floor-unknown": "No floor: no such value of real images is known",
    "images-outside": (
        "{count} images that {file} names lie outside its folder and are not shown; their folders "
        "can be allowed with {arg:images}"
    ),
    "other-split": (
        "No audit on this page is of the split that these scores are on ({splits}): what the "
        "audits say of leaks does not apply to them"
    ),
}


def _human_agreement(p: Mapping[str, Any], _: Style) -> str:
    kappa, alpha = ("not known" if p[n] is None else number(p[n]) for n in ("kappa", "alpha"))
    parts = ["No two raters answered the same trial: whether raters agree is not known"]
    if p["agree"] is not None:
        parts = [
            f"Raters agree in {percent(p['agree'])} of their common trials (Cohen's kappa {kappa}, "
            f"Krippendorff's alpha {alpha})"
        ]
    if p["repeats"]:
        parts.append(f"with themselves in {percent(p['self'])} of {plural(p['repeats'], 'repeat')}")
    if p["left"] is not None:
        parts.append(
            f"{percent(p['left'])} of {p['sides']:,} votes for a side are for the left "
            f"(p = {number(p['p_left'])})"
        )
    return "; ".join(parts)


PREFERENCE: dict[str, Sentence] = {
    "rater-excluded": (
        "Rater {rater} is excluded by the rule {rule}, fixed before the votes: {rule:rule}"
    ),
    "human-agreement": _human_agreement,
    "these-raters": lambda p, _: (
        f"For {'these' if p['count'] > 1 else 'this'} {plural(p['count'], 'rater')} only: "
        "intervals resample items, and say nothing about other people. Read as intervals of people "
        "at large, those of 40 items and two raters cover 73 % instead of 95 % in simulated "
        "studies; invite five raters or more, better ten"
    ),
    "votes-agree": (
        "The votes do not vary: no resampled interval. The bound is of Clopper and Pearson, with "
        "{items:item} as the sample"
    ),
    "one-item": "One item is no sample: no interval",
    "strength-of-prior": (
        "All votes between some methods agree: how far apart their strengths are is the prior's, "
        "N(0, 3^2) in logits, not the votes'"
    ),
    "materials-unshown": (
        "{count} of {of} materials were answers but not shown: their accuracy is not known; more "
        "items show them"
    ),
    "few-raters": (
        "{count} raters are few to say how much people differ; invite five or more, better ten"
    ),
    "votes-twice": "{count:vote} given twice count once",
    "votes-differ": (
        "{count:trial} answered twice by one rater with different answers: the "
        "later one counts. Did two people use one code?"
    ),
    "votes-late": ("{count:vote} after the end of the study are skipped"),
    "votes-so-far": ("{count:vote} so far: the server of the study has not ended, or was killed"),
    "items-left-out": (
        "{name}: {missing:item} of the reference without an image, and "
        "{unknown:image} without an item, are left out"
    ),
    "videos-unknown": "No video is known: every image counts as one of its own",
    "materials-unknown": "No material is known: items are a random sample",
    "one-video-classes": ("Of {materials:few} there is one video, and so one item at most"),
    "one-video-materials": (
        "{materials:few} cannot be sorted: the examples would show the only video"
    ),
    "sampled-items": (
        "{n} items are a sample of {candidates:,} images of {videos:,} videos, at most one a video"
    ),
    "fewer-items": (
        "{n} items instead of {wanted}: there are {candidates:,} images of {videos:,} videos, and "
        "a video gives one"
    ),
}
SENTENCES: dict[str, Sentence] = METRICS | LEAKAGE | EVALUATION | CAPTIONS | PREFERENCE | OTHER
