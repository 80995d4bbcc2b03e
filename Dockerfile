# palpate on one machine with NVIDIA GPUs, with the versions of constraints.txt. The wheels of torch bring CUDA; the
# machine needs the driver and the NVIDIA container toolkit.
#
#     docker build -t palpate .
#     docker run --gpus all --ipc host -v "$PWD:/work" palpate train generator data/ --split noleak.json -o model/
FROM python:3.11.13-slim-bookworm

ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONDONTWRITEBYTECODE=1 HF_HOME=/work/.cache/huggingface
WORKDIR /opt/palpate
COPY constraints.txt pyproject.toml README.md LICENSE ./
COPY src ./src
# torch first and alone: with a version in place, nothing that depends on it brings another build
RUN pip install "$(grep '^torch==' constraints.txt)" \
    && pip install -c constraints.txt ".[all]"
RUN useradd --create-home palpate && mkdir /work && chown palpate /work
USER palpate
WORKDIR /work
ENTRYPOINT ["palpate"]
CMD ["--help"]
