// Print each change of the contact mode, without softfinger.
//
//     apt install g++ libzmq3-dev cppzmq-dev libmsgpack-cxx-dev
//     g++ -std=c++17 -O2 -DMSGPACK_NO_BOOST examples/subscribe/subscribe.cpp -lzmq -o subscribe
//     ./subscribe                                 # tcp://127.0.0.1:5555, forever
//     ./subscribe ipc:///run/softfinger 4         # another endpoint, four changes
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>

#include <msgpack.hpp>
#include <zmq.hpp>

using Map = std::map<std::string, msgpack::object>;

int main(int count, char **words) {
    const std::string endpoint = count > 1 ? words[1] : "tcp://127.0.0.1:5555";
    long left = count > 2 ? std::atol(words[2]) : -1;
    const char *modes[] = {"free", "rolling", "sliding"};

    zmq::context_t context;
    zmq::socket_t socket(context, zmq::socket_type::sub);
    socket.connect(endpoint);
    socket.set(zmq::sockopt::subscribe, "contact");

    int mode = -1;
    while (left != 0) {
        zmq::message_t topic, body;
        if (!socket.recv(topic) || !socket.recv(body)) continue;
        const auto unpacked = msgpack::unpack(body.data<char>(), body.size()); // owns what the maps point into
        const auto message = unpacked.get().as<Map>();
        const int now = message.at("contact").as<Map>().at("mode").as<int>();
        if (now == mode) continue;
        mode = now;
        auto force = message.at("force").as<std::array<double, 3>>();
        for (double &component : force) component = std::round(1e3 * component) / 1e3 + 0.0; // without -0.000
        std::printf("%ld %s %.3f %.3f %.3f\n", message.at("tick").as<long>(), modes[mode], force[0], force[1], force[2]);
        std::fflush(stdout);
        --left;
    }
}
