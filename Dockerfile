# touchgoal on CPUs: the two commands, the simulator and the twin. Real arms want a real-time kernel, see docs/deploying.md.
#     docker build -t touchgoal . && docker run --rm touchgoal && docker run --rm touchgoal make test
FROM python:3.11-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libegl1 libgl1 make \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /touchgoal
COPY . .
RUN make setup
ENV PATH=/touchgoal/.venv/bin:$PATH
CMD ["make", "demo"]
