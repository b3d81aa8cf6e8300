// Messages as Fast CDR writes them, the library of ROS 2: one line of hexadecimal digits each.
#if !__has_include(<fastcdr/Cdr.h>)
#error Fast CDR is not installed
#endif
#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>

#include <cstdint>
#include <cstdio>
#include <functional>
#include <string>
#include <vector>

using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

static void show(const std::function<void(Cdr &)> &write) {
    FastBuffer buffer;
    Cdr cdr(buffer, Cdr::LITTLE_ENDIANNESS, Cdr::DDS_CDR);
    cdr.serialize_encapsulation();
    write(cdr);
    const auto *bytes = reinterpret_cast<const unsigned char *>(buffer.getBuffer());
    for (size_t i = 0; i < cdr.getSerializedDataLength(); i++) std::printf("%02x", bytes[i]);
    std::printf("\n");
}

static void header(Cdr &cdr) {
    cdr << std::int32_t{5} << std::uint32_t{7} << std::string("base");
}

int main() {
    show([](Cdr &cdr) {  // geometry_msgs/msg/Twist
        for (double one : {0.5, 0.0, 0.0, 0.0, 0.0, -1.25}) cdr << one;
    });
    show([](Cdr &cdr) {  // std_msgs/msg/String
        cdr << std::string("hello");
    });
    show([](Cdr &cdr) {  // sensor_msgs/msg/JointState
        header(cdr);
        cdr << std::vector<std::string>{"a", "elbow"};
        cdr << std::vector<double>{1.0, 2.5} << std::vector<double>{} << std::vector<double>{3.0};
    });
    show([](Cdr &cdr) {  // sensor_msgs/msg/Image
        header(cdr);
        cdr << std::uint32_t{2} << std::uint32_t{1} << std::string("rgb8") << std::uint8_t{0};
        cdr << std::uint32_t{3} << std::vector<std::uint8_t>{1, 2, 3, 4, 5, 6};
    });
    show([](Cdr &cdr) {  // trajectory_msgs/msg/JointTrajectory
        header(cdr);
        cdr << std::vector<std::string>{"a"} << std::uint32_t{1};
        cdr << std::vector<double>{1.5} << std::vector<double>{} << std::vector<double>{};
        cdr << std::vector<double>{} << std::int32_t{3} << std::uint32_t{9};
    });
    return 0;
}
